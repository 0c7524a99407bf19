"""Cache: what a training makes of each scene once is kept in files, and mapped when needed."""

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.cells import Descriptors, Partition
from cvtgs.config import SimplifyConfig
from cvtgs.io.tensors import add_prefix, map_tensors, save_tensors, under_prefix
from cvtgs.scene import ANTIALIASED_TAG, GaussianScene
from cvtgs.train.cases import Case, refer_case
from cvtgs.train.config import TrainConfig
from cvtgs.train.merged import MergedScene
from cvtgs.train.scenes import Source
from cvtgs.train.views import Views, look_at_scene

Part = TypeVar("Part")

CACHE_VERSION = 3
"""Part of the key of every file; to be raised when the content changes its meaning."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prepared:
    """All that a training needs of one scene.

    Attributes:
        name: Name of the scene.
        views: Images, one entry per size.
        cases: The scene at several ratios.
    """

    name: str
    views: tuple[Views, ...]
    cases: tuple[Case, ...]


def prepare(source: Source, config: TrainConfig, folder: Path) -> Prepared:
    """Return what a training needs of a scene, from the cache if it is there.

    Images and cases are kept in two files, so that trainings for other presets share images.
    Memory: that of one scene while it is prepared; what comes from the cache is mapped.
    """
    simplify = SimplifyConfig.from_preset(config.preset)
    ratios = config.data.validation_ratios if source.validates else config.data.ratios
    sizes = (config.views.validation_size,) if source.validates else config.views.sizes
    count = config.views.validation_count if source.validates else config.views.count
    scene = cache(source.make)
    views = _cached(
        folder / f"{source.name}-views-{_key(source, sizes, count, config.seed)}.safetensors",
        lambda: _packed_views(
            look_at_scene(scene(), count, size=size, seed=config.seed + place)
            for place, size in enumerate(sizes)
        ),
        _unpacked_views,
    )
    cases = _cached(
        folder / f"{source.name}-cases-{_key(source, ratios, simplify.model_dump())}.safetensors",
        lambda: _packed_cases(
            refer_case(source.name, scene(), ratio, simplify) for ratio in ratios
        ),
        partial(_unpacked_cases, source.name),
    )
    return Prepared(name=source.name, views=views, cases=cases)


def _key(source: Source, *parts: Any) -> str:
    text = json.dumps([CACHE_VERSION, source.identity, *parts], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _cached(
    path: Path,
    make: Callable[[], dict[str, Tensor]],
    unpack: Callable[[Mapping[str, Tensor]], tuple[Part, ...]],
) -> tuple[Part, ...]:
    """Unpack a file; make it first if it is missing or damaged."""
    if path.is_file():
        try:
            return unpack(map_tensors(path)[0])
        except (ValueError, KeyError, TypeError):
            path.unlink()
    save_tensors(path, make(), {})
    return unpack(map_tensors(path)[0])


def _packed_views(all_views: Iterable[Views]) -> dict[str, Tensor]:
    tensors: dict[str, Tensor] = {}
    for place, views in enumerate(all_views):
        tensors |= {
            f"{place}/viewmats": views.cameras.viewmats,
            f"{place}/Ks": views.cameras.Ks,
            f"{place}/rgb": views.rgb,
            f"{place}/alpha": views.alpha,
        }
    return tensors


def _unpacked_views(tensors: Mapping[str, Tensor]) -> tuple[Views, ...]:
    return tuple(_views(under_prefix(f"{place}/", tensors)) for place in range(_places(tensors)))


def _packed_cases(cases: Iterable[Case | None]) -> dict[str, Tensor]:
    tensors: dict[str, Tensor] = {}
    some = (case for case in cases if case is not None)
    for place, case in enumerate(some):
        reference, prefix = case.reference, f"{place}/"
        if place == 0:
            tensors |= add_prefix("scene/", reference.scene.tensors())
            tensors["light"] = reference.visibility.to(torch.float32)
            if reference.scene.antialiased:
                tensors["antialiased"] = torch.ones(1)
        tensors |= add_prefix(prefix + "merged/", reference.merged.tensors())
        tensors |= add_prefix(prefix + "seen/", _values(case.descriptors))
        tensors |= {
            prefix + "ratio": torch.tensor(case.ratio, dtype=torch.float64),
            prefix + "order": reference.partition.order.to(torch.int32),
            prefix + "offsets": reference.partition.offsets,
            prefix + "neighbors": reference.neighbors.to(torch.int32),
        }
    return tensors


def _unpacked_cases(name: str, tensors: Mapping[str, Tensor]) -> tuple[Case, ...]:
    count = _places(tensors)
    if count == 0:
        return ()
    # Merged Gaussians must be rendered as their scene is.
    comments = (ANTIALIASED_TAG,) if "antialiased" in tensors else ()
    scene = GaussianScene(**under_prefix("scene/", tensors), comments=comments)
    light = tensors["light"]
    return tuple(
        _case(name, scene, light, under_prefix(f"{place}/", tensors)) for place in range(count)
    )


def _places(tensors: Mapping[str, Tensor]) -> int:
    """Count the numbered entries."""
    return len({name.split("/")[0] for name in tensors if name.split("/")[0].isdecimal()})


def _case(name: str, scene: GaussianScene, light: Tensor, tensors: Mapping[str, Tensor]) -> Case:
    partition = Partition(order=tensors["order"].long(), offsets=tensors["offsets"])
    several = partition.counts > 1
    return Case(
        scene_name=name,
        ratio=float(tensors["ratio"]),
        reference=MergedScene(
            scene=scene,
            merged=GaussianScene(**under_prefix("merged/", tensors), comments=scene.comments),
            partition=partition,
            neighbors=tensors["neighbors"].long(),
            visibility=light,
        ),
        cells=several.nonzero()[:, 0],
        part=partition.select(several),
        descriptors=Descriptors(**under_prefix("seen/", tensors)),
    )


def _views(tensors: Mapping[str, Tensor]) -> Views:
    rgb = tensors["rgb"]
    cameras = Cameras(
        viewmats=tensors["viewmats"], Ks=tensors["Ks"], width=rgb.shape[2], height=rgb.shape[1]
    )
    return Views(cameras=cameras, rgb=rgb, alpha=tensors["alpha"])


def _values(descriptors: Descriptors) -> dict[str, Tensor]:
    return {field.name: getattr(descriptors, field.name) for field in fields(descriptors)}
