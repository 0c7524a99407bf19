"""Scenes merged up to the network: what a training learns to correct."""

from typing import NamedTuple

from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.analysis import analyze, drop_unused_bands, measure_visibility
from cvtgs.cells import Partition
from cvtgs.config import SimplifyConfig
from cvtgs.errors import InvalidArgumentError
from cvtgs.filters import filter_rows
from cvtgs.pipeline import group_rows, merge_cells
from cvtgs.scene import GaussianScene
from cvtgs.validity import check_rows, standardized


class MergedScene(NamedTuple):
    """The valid Gaussians of a scene, one merged Gaussian per cell, and what the network sees.

    The partition has the rows that each merged Gaussian stands for.
    """

    scene: GaussianScene
    merged: GaussianScene
    partition: Partition
    neighbors: Int[Tensor, "m k"]
    visibility: Float[Tensor, "n"]


def merge_scene(scene: GaussianScene, target: int, config: SimplifyConfig) -> MergedScene:
    """Run all stages before the network, to train it; fewer cells than valid Gaussians."""
    valid = check_rows(scene).scene
    if target >= len(valid):
        raise InvalidArgumentError(
            f"target must be below the {len(valid)} valid Gaussians, found {target}."
        )
    analysis = analyze(valid, config, with_visibility=True)
    if analysis.plan.visibility.active:
        analysis = measure_visibility(valid, analysis, config)
    valid = drop_unused_bands(valid, analysis.plan)
    rows = filter_rows(valid, analysis, target, config.filter).rows
    grouping = group_rows(valid, rows, analysis, target, config)
    merged = merge_cells(
        valid,
        grouping.partition,
        config.merge,
        areas=analysis.areas,
        backend=grouping.backend,
        with_network=True,
    )
    return MergedScene(
        valid,
        standardized(merged.scene),
        merged.partition,
        merged.neighbors,
        analysis.visibility,
    )
