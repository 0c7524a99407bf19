"""Cached training data: the images and cases of each scene, in memory-mapped files."""

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
from cvtgs.train.cases import Case, MergedScene, TargetViews, make_case, render_views
from cvtgs.train.config import TrainConfig
from cvtgs.train.sources import Source

Content = TypeVar("Content", TargetViews, Case)

CACHE_VERSION = 9
"""Part of every cache key; increment it when the meaning of the content changes."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrainingScene:
    """The data of one scene.

    Attributes:
        name: Name of the scene.
        views: Images, one entry per size.
        cases: The scene at several ratios.
    """

    name: str
    views: tuple[TargetViews, ...]
    cases: tuple[Case, ...]


def prepare_scene(source: Source, config: TrainConfig, folder: Path) -> TrainingScene:
    """Return the data of a scene, from the cache if possible.

    Images and cases are in separate files, so that trainings for other presets share images.
    Memory: one scene during its preparation; cached tensors are memory-mapped.
    """
    simplify = SimplifyConfig.from_preset(config.preset)
    ratios = config.data.validation_ratios if source.is_validation else config.data.ratios
    sizes = (config.views.validation_size,) if source.is_validation else config.views.sizes
    if config.kind == "published" and not source.is_validation:
        sizes = ()  # it trains on images of single cells
    count = config.views.validation_count if source.is_validation else config.views.count
    scene, file = cache(source.make), source.cameras
    seen_from = config.seed if file is None else hashlib.sha256(file.read_bytes()).hexdigest()
    views = _cached(
        folder / f"{source.name}-views-{_key(source, sizes, count, seen_from)}.safetensors",
        lambda: _packed_views(
            render_views(scene(), count, size=size, seed=config.seed + number, file=file)
            for number, size in enumerate(sizes)
        ),
        _unpacked_views,
    )
    cases = _cached(
        folder / f"{source.name}-cases-{_key(source, ratios, simplify.model_dump())}.safetensors",
        lambda: _packed_cases(make_case(source.name, scene(), ratio, simplify) for ratio in ratios),
        partial(_unpacked_cases, source.name),
    )
    return TrainingScene(name=source.name, views=views, cases=cases)


def _key(source: Source, *parts: Any) -> str:
    text = json.dumps([CACHE_VERSION, source.identity, *parts], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _cached(
    path: Path,
    make: Callable[[], dict[str, Tensor]],
    unpack: Callable[[Mapping[str, Tensor]], tuple[Content, ...]],
) -> tuple[Content, ...]:
    """Read a cache file; write it first if it is missing or damaged."""
    if path.is_file():
        try:
            return unpack(map_tensors(path)[0])
        except (ValueError, KeyError, TypeError):
            path.unlink()
    save_tensors(path, make(), {})
    return unpack(map_tensors(path)[0])


def _packed_views(all_views: Iterable[TargetViews]) -> dict[str, Tensor]:
    tensors: dict[str, Tensor] = {}
    for number, views in enumerate(all_views):
        tensors |= {
            f"{number}/viewmats": views.cameras.viewmats,
            f"{number}/Ks": views.cameras.Ks,
            f"{number}/ignores_tag": torch.tensor(views.cameras.ignores_tag, dtype=torch.bool),
            f"{number}/rgb": views.rgb,
            f"{number}/alpha": views.alpha,
        }
    return tensors


def _unpacked_views(tensors: Mapping[str, Tensor]) -> tuple[TargetViews, ...]:
    return tuple(
        _views(under_prefix(f"{number}/", tensors)) for number in range(_entry_count(tensors))
    )


def _packed_cases(cases: Iterable[Case | None]) -> dict[str, Tensor]:
    tensors: dict[str, Tensor] = {}
    for number, case in enumerate(case for case in cases if case is not None):
        reference, prefix = case.reference, f"{number}/"
        if number == 0:
            tensors |= add_prefix("scene/", reference.scene.tensors())
            tensors["visibility"] = reference.visibility.to(torch.float32)
            tensors["radius"] = torch.tensor(reference.radius, dtype=torch.float64)
            if reference.scene.antialiased:
                tensors["antialiased"] = torch.ones(1)
        tensors |= add_prefix(prefix + "merged/", reference.merged.tensors())
        described = case.descriptors
        tensors |= {
            f"{prefix}seen/{field.name}": getattr(described, field.name)
            for field in fields(described)
        }
        tensors |= {
            prefix + "ratio": torch.tensor(case.ratio, dtype=torch.float64),
            prefix + "order": reference.partition.order,
            prefix + "offsets": reference.partition.offsets,
            prefix + "neighbors": reference.neighbors,
        }
    return tensors


def _unpacked_cases(name: str, tensors: Mapping[str, Tensor]) -> tuple[Case, ...]:
    count = _entry_count(tensors)
    if count == 0:
        return ()
    # Merged Gaussians must be rendered in the same way as their scene.
    comments = (ANTIALIASED_TAG,) if "antialiased" in tensors else ()
    scene = GaussianScene(**under_prefix("scene/", tensors), comments=comments)
    shared = tensors["visibility"], float(tensors["radius"])
    return tuple(
        _case(name, scene, *shared, under_prefix(f"{number}/", tensors)) for number in range(count)
    )


def _entry_count(tensors: Mapping[str, Tensor]) -> int:
    """Count the numbered entries."""
    return len({name.split("/")[0] for name in tensors if name.split("/")[0].isdecimal()})


def _case(
    name: str,
    scene: GaussianScene,
    visibility: Tensor,
    radius: float,
    tensors: Mapping[str, Tensor],
) -> Case:
    partition = Partition(order=tensors["order"], offsets=tensors["offsets"])
    return Case(
        scene_name=name,
        ratio=float(tensors["ratio"]),
        reference=MergedScene(
            scene=scene,
            merged=GaussianScene(**under_prefix("merged/", tensors), comments=scene.comments),
            partition=partition,
            neighbors=tensors["neighbors"],
            visibility=visibility,
            radius=radius,
        ),
        cells=partition.several(),
        descriptors=Descriptors(**under_prefix("seen/", tensors)),
    )


def _views(tensors: Mapping[str, Tensor]) -> TargetViews:
    rgb = tensors["rgb"]
    cameras = Cameras(
        viewmats=tensors["viewmats"],
        Ks=tensors["Ks"],
        width=rgb.shape[2],
        height=rgb.shape[1],
        ignores_tag=tuple(tensors["ignores_tag"].tolist()),
    )
    return TargetViews(cameras=cameras, rgb=rgb, alpha=tensors["alpha"])
