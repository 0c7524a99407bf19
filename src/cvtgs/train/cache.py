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
from cvtgs.evaluation.scorer import ViewImages
from cvtgs.io.tensors import add_prefix, map_tensors, save_tensors, under_prefix
from cvtgs.scene import GaussianScene
from cvtgs.tags import ANTIALIASED
from cvtgs.train.cases import Case, MergedScene, make_case, render_targets
from cvtgs.train.config import TrainConfig
from cvtgs.train.sources import Source

Content = TypeVar("Content", ViewImages, Case)

CACHE_VERSION = 9  # part of every cache key; increment it when the meaning of the content changes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrainingScene:
    """The data of one scene."""

    name: str
    views: tuple[ViewImages, ...]  # one entry per size of images
    cases: tuple[Case, ...]  # the scene at several ratios


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
            render_targets(scene(), count, size=size, seed=config.seed + number, file=file)
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


def _packed_views(all_views: Iterable[ViewImages]) -> dict[str, Tensor]:
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


def _unpacked_views(tensors: Mapping[str, Tensor]) -> tuple[ViewImages, ...]:
    found = []
    for entry in _entries(tensors):
        rgb = entry["rgb"]
        cameras = Cameras(
            viewmats=entry["viewmats"],
            Ks=entry["Ks"],
            width=rgb.shape[2],
            height=rgb.shape[1],
            ignores_tag=tuple(entry["ignores_tag"].tolist()),
        )
        found.append(ViewImages(cameras=cameras, rgb=rgb, alpha=entry["alpha"]))
    return tuple(found)


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
    entries = _entries(tensors)
    if not entries:
        return ()
    # Merged Gaussians must be rendered in the same way as their scene.
    comments = (ANTIALIASED.text,) if "antialiased" in tensors else ()
    scene = GaussianScene(**under_prefix("scene/", tensors), comments=comments)
    found = []
    for entry in entries:
        partition = Partition(order=entry["order"], offsets=entry["offsets"])
        reference = MergedScene(
            scene=scene,
            merged=GaussianScene(**under_prefix("merged/", entry), comments=comments),
            partition=partition,
            neighbors=entry["neighbors"],
            visibility=tensors["visibility"],
            radius=float(tensors["radius"]),
        )
        case = Case(
            scene_name=name,
            ratio=float(entry["ratio"]),
            reference=reference,
            cells=partition.several(),
            descriptors=Descriptors(**under_prefix("seen/", entry)),
        )
        found.append(case)
    return tuple(found)


def _entries(tensors: Mapping[str, Tensor]) -> list[dict[str, Tensor]]:
    """Return the tensors of the numbered entries."""
    count = len({name.split("/")[0] for name in tensors if name.split("/")[0].isdecimal()})
    return [under_prefix(f"{number}/", tensors) for number in range(count)]
