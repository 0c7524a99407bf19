"""Scenes, configurations and comparisons that the tests of training share."""

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import cvtgs
from cvtgs import GaussianScene
from cvtgs.config import SimplifyConfig
from cvtgs.evaluation.scorer import ViewImages
from cvtgs.io.tensors import map_tensors
from cvtgs.mergenet import Architecture, LearnedScene, MergeNet
from cvtgs.train import DataConfig, History, Source, TrainConfig, TrainFiles, ViewsConfig, train
from cvtgs.train.cases import Case, make_case, render_targets

needs_matplotlib = pytest.mark.skipif(
    importlib.util.find_spec("matplotlib") is None, reason="matplotlib is optional"
)


def small_scene(count: int = 600, *, kind: str = "object", seed: int = 0) -> GaussianScene:
    return cvtgs.synthetic.scene(kind, count, sh_degree=seed % 2, seed=seed)


def write_scenes(folder: Path, names: Sequence[str], count: int = 600) -> Path:
    """Save one scene per name; the seed is the index of the name."""
    for seed, name in enumerate(names):
        path = folder / f"{name}.ply"
        path.parent.mkdir(parents=True, exist_ok=True)
        cvtgs.save(small_scene(count, seed=seed), path)
    return folder


def tiny_data(folder: Path, **changes: Any) -> DataConfig:
    """Learn from all files but ``exam``, at one ratio."""
    values: dict[str, Any] = {
        "folders": (folder,),
        "validation": ("exam",),
        "generated": 0,
        "generated_validation": 0,
        "blocks": 0,
        "ratios": (0.05,),
        "validation_ratios": (0.06,),
    }
    return DataConfig(**(values | changes))


def tiny_config(data: DataConfig, **changes: Any) -> TrainConfig:
    """Settings for a training of a second: a small network, images of 32 pixels, few cells."""
    values: dict[str, Any] = {
        "data": data,
        "steps": 6,
        "validate_every": 2,
        "width": 6,
        "cell_width": 10,
        "cells": 9,
        "views": ViewsConfig(
            count=4, sizes=(32, 40), crop=32, validation_count=2, validation_size=36
        ),
    }
    return TrainConfig(**(values | changes))


def run(config: TrainConfig, name: Path, cache: Path | None = None, **options: Any) -> History:
    """Train to files that are named after ``name``."""
    return train(config, TrainFiles.beside(name, cache), **options)


def source_of(scene: GaussianScene, *, name: str = "made", is_validation: bool = False) -> Source:
    """A source of a scene that is already made."""
    return Source(
        name=name,
        identity=f"identity of {name}",
        is_validation=is_validation,
        origin=LearnedScene(name=name, count=len(scene), is_validation=is_validation),
        make=lambda: scene,
    )


def some_case(
    count: int = 600, *, ratio: float = 0.05, seed: int = 0, preset: str = "standard"
) -> Case:
    config = SimplifyConfig.from_preset(preset)
    case = make_case("some", small_scene(count, seed=seed), ratio, config)
    assert case is not None
    return case


def some_views(count: int = 600, *, seed: int = 0, size: int = 32) -> ViewImages:
    return render_targets(small_scene(count, seed=seed), 2, size=size, seed=0)


def small_net(seed: int = 0) -> MergeNet:
    """A network that changes nothing yet."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return MergeNet(Architecture(width=6, cell_width=10))


def bits(tensor: Tensor) -> tuple[torch.dtype, tuple[int, ...], bytes]:
    return tensor.dtype, tuple(tensor.shape), tensor.contiguous().numpy().tobytes()


def bits_of(tensors: dict[str, Tensor]) -> dict[str, Any]:
    return {name: bits(values) for name, values in tensors.items()}


def bits_of_case(case: Case) -> dict[str, Any]:
    """All contents of a case, for comparison bit for bit."""
    reference, seen = case.reference, case.descriptors
    return {
        "names": (case.scene_name, case.ratio, reference.merged.antialiased, reference.radius),
        "scene": bits_of(reference.scene.tensors()),
        "merged": bits_of(reference.merged.tensors()),
        "cells": bits(case.cells),
        "part": (bits(case.part.order), bits(case.part.offsets)),
        "partition": (bits(reference.partition.order), bits(reference.partition.offsets)),
        "neighbors": bits(reference.neighbors),
        "light": bits(reference.visibility.float()),
        "seen": {name: bits(getattr(seen, name)) for name in type(seen).__slots__},
    }


def bits_of_views(views: ViewImages) -> dict[str, Any]:
    cameras = views.cameras
    modes = cameras.ignores_tag
    return {
        "cameras": (bits(cameras.viewmats), bits(cameras.Ks), cameras.width, cameras.height, modes),
        "images": (bits(views.rgb), bits(views.alpha)),
    }


def bits_of_state(path: Path) -> tuple[dict[str, Any], dict[str, str]]:
    tensors, metadata = map_tensors(path)
    return bits_of(tensors), metadata
