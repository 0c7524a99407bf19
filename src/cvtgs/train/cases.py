"""Cases: scenes at a ratio, as far as no training step changes them."""

from dataclasses import dataclass

import torch
from jaxtyping import Int
from torch import Tensor

from cvtgs.cells import Descriptors, Partition, describe_cells
from cvtgs.config import SimplifyConfig
from cvtgs.counts import target_count
from cvtgs.mergenet import Residuals, compose
from cvtgs.scene import GaussianScene
from cvtgs.train.merged import MergedScene, merge_scene


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Case:
    """A scene at a ratio: its merged Gaussians, and what the network sees of them.

    Attributes:
        scene_name: Name of the scene.
        ratio: Gaussians kept, as a share.
        reference: Scene, merged Gaussians, cells, neighbours.
        cells: ``(r,)`` cells of several members: those that the network corrects.
        part: Members of these cells.
        descriptors: What the network sees of these cells.
    """

    scene_name: str
    ratio: float
    reference: MergedScene
    cells: Int[Tensor, "r"]
    part: Partition
    descriptors: Descriptors

    @property
    def name(self) -> str:
        """Scene and ratio."""
        return f"{self.scene_name} at {self.ratio:g}"

    def select(self, rows: Int[Tensor, "s"]) -> "Case":
        """Take some of the cells, and describe them anew."""
        chosen = torch.zeros(len(self.cells), dtype=torch.bool, device=self.cells.device)
        chosen[rows] = True
        part = self.part.select(chosen)
        return make_case(self.scene_name, self.ratio, self.reference, self.cells[chosen], part)

    def changed(self, residuals: Residuals) -> dict[str, Tensor]:
        """Change the cells, differentiably."""
        return compose(
            self.reference.scene,
            self.reference.merged,
            self.part,
            cells=self.cells,
            neighbors=self.reference.neighbors[self.cells],
            residuals=residuals,
        )

    def corrected(self, residuals: Residuals) -> GaussianScene:
        """Return the whole small scene with its cells changed, differentiably."""
        merged = self.reference.merged
        changed = self.changed(residuals)
        return merged.with_tensors(
            {
                name: values.index_copy(0, self.cells, changed[name])
                for name, values in merged.tensors().items()
            },
            {},
        )

    def to(self, device: torch.device) -> "Case":
        """Move the case to a device."""
        reference, part = self.reference, self.part
        if reference.scene.device == device:
            return self
        moved = MergedScene(
            scene=reference.scene.to(device),
            merged=reference.merged.to(device),
            partition=reference.partition.to(device),
            neighbors=reference.neighbors.to(device),
            visibility=reference.visibility.to(device),
        )
        return Case(
            scene_name=self.scene_name,
            ratio=self.ratio,
            reference=moved,
            cells=self.cells.to(device),
            part=part.to(device),
            descriptors=self.descriptors.to(device),
        )


def make_case(
    scene_name: str, ratio: float, reference: MergedScene, cells: Tensor, part: Partition
) -> Case:
    """Describe some cells of a reference."""
    described = describe_cells(
        reference.scene,
        reference.merged,
        part,
        cells=cells,
        neighbors=reference.neighbors[cells],
        sizes=reference.partition.counts,
        visibility=reference.visibility,
    )
    return Case(
        scene_name=scene_name,
        ratio=ratio,
        reference=reference,
        cells=cells,
        part=part,
        descriptors=described,
    )


def refer_case(
    scene_name: str, scene: GaussianScene, ratio: float, config: SimplifyConfig
) -> Case | None:
    """Simplify a scene without a network, and describe its cells."""
    target = target_count(len(scene), ratio)
    if target >= len(scene):
        return None
    reference = merge_scene(scene, target, config)
    several = reference.partition.counts > 1
    cells = several.nonzero()[:, 0]
    if not len(cells):
        return None
    return make_case(scene_name, ratio, reference, cells, reference.partition.select(several))
