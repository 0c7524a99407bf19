"""Visibility in blocks: contributions of Gaussians to images, measured before cells form.

The images show the whole scene, from the same cameras for all blocks. A block is rendered with all
of its Gaussians; a sample of the scene, enlarged to cover the same area, stands for the others.
"""

import json
import math

import torch

from cvtgs.analysis.analyze import drop_mip_tag, measured_areas, visibility_cameras
from cvtgs.boxes import inside
from cvtgs.cameras import Cameras
from cvtgs.devices import one_thread
from cvtgs.io.tensors import add_prefix, map_tensors, save_tensors, under_prefix
from cvtgs.outofcore.job import Job
from cvtgs.outofcore.rows import BlockRows, read_rows
from cvtgs.rendering import contributions
from cvtgs.scene import GaussianScene, concatenate

MEASURED = "measured.json"  # file of the sums over all blocks
SCENE = "scene/"


@one_thread()
def write_views(job: Job, sample: GaussianScene, *, total: int) -> None:
    """Choose cameras by a sample of ``total`` Gaussians, or from given ones; write both."""
    cameras = visibility_cameras(sample, job.config, cameras=job.cameras)
    enlarged = sample.log_scales + 0.5 * math.log(total / len(sample))
    tensors = sample.with_sh_degree(0).tensors() | {"log_scales": enlarged}
    save_tensors(
        job.views_path,
        {
            "viewmats": cameras.viewmats,
            "Ks": cameras.Ks,
            "strides": torch.tensor(cameras.strides, dtype=torch.int64),
            "ignores_tag": torch.tensor(cameras.ignores_tag, dtype=torch.bool),
            **add_prefix(SCENE, tensors),
        },
        {name: str(getattr(cameras, name)) for name in ("width", "height")},
    )


@one_thread()
def measure(job: Job, block: int) -> None:
    """Write the contributions of the Gaussians of a block, and their sums."""
    if job.has("contributions", block):
        return
    scan, rows = job.read_scan(), read_rows(job, block, is_slim=True)
    tensors, facts = map_tensors(job.views_path)
    cameras = Cameras(
        viewmats=tensors["viewmats"],
        Ks=tensors["Ks"],
        width=int(facts["width"]),
        height=int(facts["height"]),
        strides=tuple(tensors["strides"].tolist()),
        ignores_tag=tuple(tensors["ignores_tag"].tolist()),
    )
    sample = rows.scene.with_tensors(under_prefix(SCENE, tensors), {})
    blocks = scan.partition.blocks_of(scan.frame.contract(sample.means))
    others = sample.select((blocks != block) | inside(job.boxes, sample.means))
    drawn = drop_mip_tag(concatenate([rows.scene, others]), scan.plan)
    found = contributions(drawn, cameras)[: len(rows.scene)].contiguous()
    mass = (rows.apparent_areas * rows.scene.opacities).double().sum()
    tensors = {"contributions": found, "pixels": found.sum(), "mass": mass}
    job.write("contributions", block, tensors)


def add_contributions(job: Job) -> None:
    """Write the sums of masses and contributions over all blocks."""
    sums = {"mass": 0.0, "pixels": 0.0}
    for block in job.blocks_with_rows():
        tensors = job.read("contributions", block)
        sums = {name: total + float(tensors[name]) for name, total in sums.items()}
    job.write_file(MEASURED, json.dumps(sums).encode())


def read_apparent_rows(job: Job, block: int, *, is_slim: bool = True) -> BlockRows:
    """Read rows, with the areas that images measured if there are images."""
    rows = read_rows(job, block, is_slim=is_slim)
    if not job.config.uses_renders:
        return rows
    sums = json.loads(job.path(MEASURED).read_bytes())
    if sums["pixels"] == 0.0:
        return rows
    measured = measured_areas(
        rows.apparent_areas,
        rows.scene.opacities,
        job.read("contributions", block)["contributions"],
        mass_per_pixel=torch.tensor(sums["mass"] / sums["pixels"], dtype=torch.float64),
        share=job.config.visibility.mass_share,
    )
    return rows._replace(apparent_areas=measured)
