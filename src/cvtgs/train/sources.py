"""Scenes for training and validation: files, pieces of them, perturbed copies, generated scenes."""

import hashlib
import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch

from cvtgs import synthetic
from cvtgs.errors import ConfigError
from cvtgs.io import load
from cvtgs.io.files import is_folder
from cvtgs.math import parameters
from cvtgs.mergenet import LearnedScene
from cvtgs.scene import GaussianScene
from cvtgs.tags import ANTIALIASED
from cvtgs.train.config import DataConfig
from cvtgs.validity import valid_part

VALIDATION_SEED = 1_000_000  # first seed of generated validation scenes
TAGGED = 0.5  # share of perturbed copies that are tagged ``SplatRenderMode: mip``; few files are


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """A named scene that is made lazily.

    Attributes:
        name: Unique name.
        identity: Text that changes when the scene does; part of the key of its cache.
        is_validation: Whether it is for validation only.
        origin: The file or generated scene that it is or is derived from.
        make: Function that makes the scene.
        cameras: File of cameras for validation; None finds views.
    """

    name: str
    identity: str
    is_validation: bool
    origin: LearnedScene
    make: Callable[[], GaussianScene]
    cameras: Path | None = None


def find_sources(config: DataConfig, *, seed: int) -> list[Source]:
    """List the scenes of a training without making them: files by name, then generated ones."""
    files = [path for folder in config.folders for path in _files_in(folder)]
    names = [path.stem for path in files]
    held_out = set(config.validation) or set(names[1::5])
    missing = sorted(held_out - set(names))
    if missing:
        raise ConfigError(f"data.validation: no file named {missing[0]}.ply in data.folders.")
    sources = [*_from_files(files, held_out, config, seed), *_generated(config, seed)]
    if len({source.name for source in sources}) < len(sources):
        raise ConfigError("data.folders: two files have the same name.")
    for is_validation, text in ((False, "training"), (True, "validation")):
        if not any(source.is_validation == is_validation for source in sources):
            raise ConfigError(f"data: at least one {text} scene is needed, found none.")
    return sources


def _files_in(folder: Path) -> list[Path]:
    if not is_folder(folder):
        raise ConfigError(f"data.folders: {folder} is not a folder.")
    files = sorted(folder.rglob("*.ply"))
    if not files:
        raise ConfigError(f"data.folders: {folder} holds no PLY file.")
    return files


def _from_files(
    files: list[Path], held_out: set[str], config: DataConfig, seed: int
) -> Iterator[Source]:
    for path in files:
        count, name = len(load(path)), path.stem
        with path.open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        is_validation, cameras = name in held_out, path.with_suffix(".transforms.json")
        whole = Source(
            name=name,
            identity=sha256,
            is_validation=is_validation,
            origin=LearnedScene(name=name, count=count, sha256=sha256, is_validation=is_validation),
            make=partial(_load_valid, path),
            cameras=cameras if is_validation and cameras.is_file() else None,
        )
        if is_validation:
            yield whole
            continue
        originals = [whole] if count <= config.largest_scene else []
        yield from originals
        for number in range(config.blocks if count > config.block_count else 0):
            block = replace(
                whole,
                name=f"{name}-block{number}",
                identity=f"{sha256} block {config.block_count} {seed + number}",
                make=partial(_block_of, whole, config.block_count, seed + number),
            )
            originals.append(block)
            yield block
        yield from _copies(originals, config.copies, seed)


def _load_valid(path: Path) -> GaussianScene:
    return valid_part(load(path))


def _block_of(source: Source, count: int, seed: int) -> GaussianScene:
    return cut_block(source.make(), count, seed=seed)


def _perturbed(source: Source, seed: str) -> GaussianScene:
    return perturb(source.make(), random.Random(seed))


def _copies(originals: list[Source], count: int, seed: int) -> Iterator[Source]:
    for original in originals:
        for number in range(count):
            name = f"{original.name}-copy{number}"
            yield replace(
                original,
                name=name,
                identity=f"{original.identity} copy {seed} {number}",
                make=partial(_perturbed, original, f"{seed}/{name}"),
            )


def _generated(config: DataConfig, seed: int) -> Iterator[Source]:
    counts = config.generated_counts
    for is_validation, number, first in (
        (False, config.generated, 1000 * seed),
        (True, config.generated_validation, VALIDATION_SEED + 1000 * seed),
    ):
        for turn in range(number):
            for place, kind in enumerate(synthetic.KINDS):
                count, degree = counts[(turn + place) % len(counts)], (turn + place) % 3
                name = f"generated-{kind}-{first + turn}"
                yield Source(
                    name=name,
                    identity=f"{name} {count} {degree}",
                    is_validation=is_validation,
                    origin=LearnedScene(name=name, count=count, is_validation=is_validation),
                    make=partial(synthetic.scene, kind, count, sh_degree=degree, seed=first + turn),
                )


def cut_block(scene: GaussianScene, count: int, *, seed: int) -> GaussianScene:
    """Cut a compact piece out of a scene: a random Gaussian and its nearest neighbours."""
    if len(scene) <= count:
        return scene
    middle = scene.means[random.Random(seed).randrange(len(scene))]
    distances = torch.linalg.vector_norm(scene.means - middle, dim=1)
    return scene.select(distances.topk(count, largest=False).indices.sort().values)


def perturb(scene: GaussianScene, rng: random.Random) -> GaussianScene:
    """Thin, stretch and recolour a scene, and draw whether it is tagged ``SplatRenderMode: mip``.

    Rotations, translations and uniform scales would add nothing: descriptors are invariant to them.
    """
    generator = torch.Generator().manual_seed(rng.getrandbits(62))
    share = rng.uniform(0.4, 1.0)
    kept = scene.select(torch.rand(len(scene), generator=generator) < share)
    kept = kept if len(kept) else scene
    stretch = torch.tensor([rng.uniform(0.6, 1.5) for _ in range(3)], dtype=scene.dtype)
    wider = share ** (-1 / 3)
    quats = parameters.normalize_quats(kept.quats.double())
    shapes = parameters.build_covariances(kept.scales.double() * wider, quats)
    scales, turned = parameters.decompose_covariances(shapes * stretch[:, None] * stretch)
    mix = torch.eye(3) * rng.uniform(0.5, 1.4) + 0.3 * torch.randn(3, 3, generator=generator)
    mix = mix.to(scene.dtype)
    changed = kept.with_tensors(
        {
            "means": kept.means * stretch,
            "log_scales": parameters.positive_log(scales).to(scene.dtype),
            "quats": turned.to(scene.dtype),
            "logit_opacities": kept.logit_opacities + rng.triangular(-2.0, 4.0, 0.0),
            "sh0": kept.sh0 @ mix,
            "shN": kept.shN @ mix,
        },
        {},
    )
    return replace(changed, comments=(ANTIALIASED.text,) if rng.random() < TAGGED else ())
