"""Cache: what a training makes of each scene once is kept in files, and mapped when needed."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.cells import Descriptors, Partition
from cvtgs.config import SimplifyConfig
from cvtgs.errors import FileFormatError
from cvtgs.io.tensors import map_tensors, save_tensors
from cvtgs.scene import GaussianScene
from cvtgs.stages import Reference
from cvtgs.train.cases import Case, Views, look_at_scene, refer_case
from cvtgs.train.config import TrainConfig
from cvtgs.train.scenes import Source

CACHE_VERSION = 1
"""Part of the key of every file; to be raised when the content changes its meaning."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prepared:
    """All that a training needs of one scene.

    Attributes:
        name: Name of the scene.
        views: Pictures, one entry per size.
        cases: The scene at several ratios.
    """

    name: str
    views: tuple[Views, ...]
    cases: tuple[Case, ...]


def prepare(source: Source, config: TrainConfig, folder: Path) -> Prepared:
    """Give what a training needs of a scene, from the cache if it is there.

    Memory: that of one scene while it is prepared; what comes from the cache is mapped.

    Args:
        source: The scene.
        config: The training.
        folder: Where the cache is; it must exist.

    Returns:
        Views and cases.

    Raises:
        OutputError: The cache cannot be written.
    """
    simplify = SimplifyConfig.from_preset(config.preset)
    path = folder / f"{source.name}-{_key(source, config, simplify)}.safetensors"
    if path.is_file():
        try:
            return _unpacked(source.name, *map_tensors(path))
        except (FileFormatError, KeyError):
            path.unlink()
    prepared = _made(source, config, simplify)
    tensors, facts = _packed(prepared)
    save_tensors(path, tensors, {"facts": json.dumps(facts)})
    return _unpacked(source.name, *map_tensors(path))


def _key(source: Source, config: TrainConfig, simplify: SimplifyConfig) -> str:
    data = config.data
    parts = {
        "version": CACHE_VERSION,
        "identity": source.identity,
        "simplify": simplify.model_dump(mode="json"),
        "ratios": data.validation_ratios if source.validates else data.ratios,
        "views": config.views.model_dump(mode="json"),
        "seed": config.seed,
    }
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]


def _made(source: Source, config: TrainConfig, simplify: SimplifyConfig) -> Prepared:
    scene, data, views = source.make(), config.data, config.views
    ratios = data.validation_ratios if source.validates else data.ratios
    sizes = (views.validation_size,) if source.validates else views.sizes
    count = views.validation_count if source.validates else views.count
    cases = []
    for ratio in ratios:
        case = refer_case(source.name, scene, ratio, simplify)
        if case is not None:
            cases.append(case)
    return Prepared(
        name=source.name,
        views=tuple(
            look_at_scene(scene, count, size=size, seed=config.seed + place)
            for place, size in enumerate(sizes)
        ),
        cases=tuple(cases),
    )


def _packed(prepared: Prepared) -> tuple[dict[str, Tensor], dict[str, list[float]]]:
    tensors: dict[str, Tensor] = {}
    for place, views in enumerate(prepared.views):
        tensors |= {
            f"views{place}/viewmats": views.cameras.viewmats,
            f"views{place}/Ks": views.cameras.Ks,
            f"views{place}/rgb": views.rgb,
            f"views{place}/alpha": views.alpha,
        }
    for place, case in enumerate(prepared.cases):
        reference, prefix = case.reference, f"case{place}/"
        if place == 0:
            tensors |= _prefixed("scene/", reference.scene.tensors())
            tensors["light"] = reference.light.to(torch.float32)
        tensors |= _prefixed(prefix + "merged/", reference.merged.tensors())
        tensors |= _prefixed(prefix + "seen/", _values(case.descriptors))
        tensors |= {
            prefix + "order": reference.partition.order.to(torch.int32),
            prefix + "offsets": reference.partition.offsets,
            prefix + "neighbors": reference.neighbors.to(torch.int32),
        }
    return tensors, {
        "ratios": [case.ratio for case in prepared.cases],
        "views": [float(len(views.cameras)) for views in prepared.views],
    }


def _unpacked(name: str, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> Prepared:
    facts = json.loads(metadata["facts"])
    scene = None
    cases = []
    for place, ratio in enumerate(facts["ratios"]):
        if scene is None:
            scene = GaussianScene(**_below("scene/", tensors))
        cases.append(_case(name, ratio, scene, tensors["light"], _below(f"case{place}/", tensors)))
    return Prepared(
        name=name,
        views=tuple(
            _views(_below(f"views{place}/", tensors)) for place in range(len(facts["views"]))
        ),
        cases=tuple(cases),
    )


def _case(
    name: str, ratio: float, scene: GaussianScene, light: Tensor, tensors: Mapping[str, Tensor]
) -> Case:
    partition = Partition(order=tensors["order"].long(), offsets=tensors["offsets"])
    several = partition.counts > 1
    return Case(
        scene_name=name,
        ratio=ratio,
        reference=Reference(
            scene=scene,
            merged=GaussianScene(**_below("merged/", tensors)),
            partition=partition,
            neighbors=tensors["neighbors"].long(),
            light=light,
        ),
        cells=several.nonzero()[:, 0],
        part=partition.select(several),
        descriptors=Descriptors(**_below("seen/", tensors)),
    )


def _views(tensors: Mapping[str, Tensor]) -> Views:
    rgb = tensors["rgb"]
    cameras = Cameras(
        viewmats=tensors["viewmats"], Ks=tensors["Ks"], width=rgb.shape[2], height=rgb.shape[1]
    )
    return Views(cameras=cameras, rgb=rgb, alpha=tensors["alpha"])


def _values(descriptors: Descriptors) -> dict[str, Tensor]:
    return {field.name: getattr(descriptors, field.name) for field in fields(descriptors)}


def _prefixed(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {prefix + name: values for name, values in tensors.items()}


def _below(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Any]:
    return {
        name.removeprefix(prefix): values
        for name, values in tensors.items()
        if name.startswith(prefix)
    }
