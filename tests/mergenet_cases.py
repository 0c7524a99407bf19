"""Cells, networks and comparisons that the tests of descriptors and MergeNet share."""

from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

import mergenet_oracle as oracle
from cvtgs import GaussianScene
from cvtgs.cells import Descriptors, Partition, align_axes, describe_cells, merge_cells
from cvtgs.cells.descriptors import LEAST_PIXELS, PIXEL_SCALE
from cvtgs.config import MergeConfig
from cvtgs.cvt import nearest_neighbors
from cvtgs.math.frames import robust_frame
from cvtgs.mergenet import Architecture, MergeNet, Residuals, compose, correct_cells
from cvtgs.tags import ANTIALIASED
from scenes import random_scene


class Case(NamedTuple):
    """Cells before their network corrects them, and its inputs."""

    scene: GaussianScene
    merged: GaussianScene
    part: Partition
    neighbors: Tensor
    visibility: Tensor
    pixel_size: float

    @property
    def cells(self) -> Tensor:
        return torch.arange(len(self.part), device=self.neighbors.device)

    def describe(self) -> Descriptors:
        return describe_cells(
            self.scene,
            self.merged,
            self.part,
            cells=self.cells,
            neighbors=self.neighbors,
            sizes=self.part.counts,
            visibility=self.visibility,
            pixel_size=self.pixel_size,
        )

    def compose(self, residuals: Residuals) -> dict[str, Tensor]:
        return compose(
            self.scene,
            self.merged,
            self.part,
            cells=self.cells,
            neighbors=self.neighbors,
            residuals=residuals,
        )

    def correct(self, net: MergeNet) -> GaussianScene:
        return correct_cells(
            net,
            self.scene,
            self.merged,
            self.part,
            neighbors=self.neighbors,
            visibility=self.visibility,
            pixel_size=self.pixel_size,
        )

    def oracle_cells(self) -> list[oracle.Cell]:
        members = oracle_gaussians(self.scene)
        merged = oracle_gaussians(self.merged)
        ends = self.part.offsets.tolist()
        return [
            oracle.Cell(
                own=merged[cell],
                members=[members[row] for row in self.part.order[start:end].tolist()],
                visibilities=self.visibility[self.part.order[start:end]].tolist(),
                others=[merged[other] for other in self.neighbors[cell].tolist()],
                other_sizes=self.part.counts[self.neighbors[cell]].tolist(),
                antialiased=self.scene.antialiased,
                pixel_size=self.pixel_size,
            )
            for cell, (start, end) in enumerate(pairwise(ends))
        ]


def oracle_gaussians(scene: GaussianScene) -> list[oracle.Gaussian]:
    columns = zip(
        scene.means.tolist(),
        scene.quats.tolist(),
        scene.log_scales.tolist(),
        scene.logit_opacities.tolist(),
        scene.sh0[:, 0].tolist(),
        strict=True,
    )
    return [oracle.gaussian(*row) for row in columns]


def case_of(
    scene: GaussianScene,
    labels: Tensor,
    *,
    visibility: Tensor | None = None,
    near: int = 8,
    config: MergeConfig | None = None,
) -> Case:
    """Merge given cells; visibilities are random in 0 to 1 unless given."""
    part = Partition.from_labels(labels, int(labels.amax()) + 1)
    merged = merge_cells(scene, part, config=config or MergeConfig())
    if visibility is None:
        visibility = torch.rand(len(scene), generator=torch.Generator().manual_seed(5))
    neighbors = nearest_neighbors(merged.means, near)
    merged = align_axes(merged, part, neighbors)
    pixel_size = robust_frame(scene.means).radius / 400
    return Case(scene, merged, part, neighbors, visibility.double(), pixel_size)


def some_labels(count: int, cells: int, *, seed: int = 0) -> Tensor:
    """Cells of various sizes, none of them empty."""
    labels = torch.randint(0, cells, (count,), generator=torch.Generator().manual_seed(seed))
    labels[:cells] = torch.arange(cells)
    return labels


def some_case(
    count: int = 60,
    cells: int = 12,
    *,
    degree: int = 1,
    dtype: torch.dtype = torch.float64,
    seed: int = 0,
    near: int = 8,
    tagged: bool = False,
) -> Case:
    scene = random_scene(count, degree=degree, dtype=dtype, seed=seed, size=0.4)
    if tagged:
        scene = replace(scene, comments=(ANTIALIASED.text,))
    return case_of(scene, some_labels(count, cells), near=near)


def lively_net(
    dtype: torch.dtype = torch.float64,
    *,
    seed: int = 0,
    architecture: Architecture | None = None,
) -> MergeNet:
    """A network that changes everything: no layer is zero; the same in every dtype."""
    net = MergeNet(architecture or Architecture())
    g = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for values in net.parameters():
            fan_in = values.shape[-1] if values.ndim > 1 else 4
            draws = torch.randn(values.shape, generator=g, dtype=torch.float64)
            values.copy_(draws / fan_in**0.5)
    return net.to(dtype)


def fields_of(residuals: Residuals) -> dict[str, Tensor]:
    return {name: getattr(residuals, name) for name in Residuals.__slots__}


def are_corrected(case: "Case") -> Tensor:
    """Return which cells are large enough in images for the network to correct them."""
    return case.describe().cells[:, -1] > PIXEL_SCALE * (LEAST_PIXELS - 0.99)


def features_of(seen: Descriptors) -> dict[str, Tensor]:
    """Features that a motion must not change: all but positions, whose signs follow the axes."""
    return {name: getattr(seen, name) for name in ("members", "pairs", "cells", "weights")}


def assert_same_features(
    first: Descriptors, second: Descriptors, *, tolerance: float = 1e-9
) -> None:
    for name, values in features_of(first).items():
        other = features_of(second)[name]
        torch.testing.assert_close(values, other, rtol=tolerance, atol=tolerance, msg=name)
    for name in ("positions", "pair_positions"):
        ours, theirs = getattr(first, name).abs(), getattr(second, name).abs()
        torch.testing.assert_close(ours, theirs, rtol=tolerance, atol=tolerance, msg=name)
