"""Training cases: scenes simplified to a ratio, and images of full scenes as targets."""

from collections import OrderedDict
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.analysis import analyze, drop_unused_bands
from cvtgs.cameras import Cameras
from cvtgs.cells import Descriptors, Partition, describe_cells
from cvtgs.clock import StageClock
from cvtgs.config import SimplifyConfig
from cvtgs.counts import target_count
from cvtgs.errors import InvalidArgumentError
from cvtgs.evaluation.blind_views import check_seen
from cvtgs.evaluation.scorer import ViewImages, render_views
from cvtgs.io import load_cameras
from cvtgs.mergenet import MergeNet, Net, Residuals, compose
from cvtgs.mergenet.apply import compose_published
from cvtgs.mergenet.published import describe_published
from cvtgs.pipeline import group_and_merge
from cvtgs.progress import silent
from cvtgs.scene import GaussianScene
from cvtgs.validity import check_rows
from cvtgs.views import mixed_views

IMAGE_SIZE = 400  # longer side of the images for which the cells of a case are described, pixels
DEVICE_BYTES = 10**9  # memory for copies on devices that do not report their free memory, bytes


class MergedScene(NamedTuple):
    """The valid Gaussians of a scene, and one merged Gaussian per cell, before the network."""

    scene: GaussianScene
    merged: GaussianScene
    partition: Partition
    neighbors: Int[Tensor, "m k"]
    visibility: Float[Tensor, "n"]
    radius: float  # of what one view of the scene shows


def merge_scene(scene: GaussianScene, target: int, config: SimplifyConfig) -> MergedScene:
    """Run all stages before the network, without images; ``target`` is below the valid count."""
    valid = check_rows(scene).scene
    if target >= len(valid):
        raise InvalidArgumentError(
            f"target must be below the {len(valid)} valid Gaussians, found {target}."
        )
    analysis = analyze(valid, config, with_visibility=True)
    valid = drop_unused_bands(valid, analysis.plan)
    clock = StageClock(silent, valid.device)
    merged = group_and_merge(valid, analysis, target, config, with_network=True, clock=clock)[0]
    return MergedScene(valid, *merged, analysis.visibility, analysis.frame.view_radius)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Case:
    """A scene simplified to a ratio without a network, and the descriptors of its cells."""

    scene_name: str
    ratio: float  # share of Gaussians kept
    reference: MergedScene
    cells: Int[Tensor, "r"]  # of several members, which the network corrects
    descriptors: Descriptors  # of these cells, for images of ``IMAGE_SIZE``

    @property
    def name(self) -> str:
        """The scene name and ratio as text."""
        return f"{self.scene_name} at {self.ratio:g}"

    @property
    def part(self) -> Partition:
        """All members of these cells; copied, as those of a prepared case are memory-mapped."""
        return self.reference.partition.select(self.cells)

    def select(self, rows: Int[Tensor, "s"]) -> "Case":
        """Return the case restricted to some of its cells."""
        return replace(self, cells=self.cells[rows], descriptors=self.descriptors.select(rows))

    def seen_by(self, cameras: Cameras) -> "Case":
        """Return the case with descriptors for the image size of some cameras."""
        side = max(cameras.width, cameras.height)
        return replace(self, descriptors=self.descriptors.in_images(side / IMAGE_SIZE))

    def correct_cells(self, residuals: Residuals) -> dict[str, Tensor]:
        """Return the tensors of the corrected cells, differentiably."""
        return compose(
            self.reference.scene,
            self.reference.merged,
            self.descriptors.part,
            cells=self.cells,
            neighbors=self.reference.neighbors[self.cells],
            residuals=residuals,
        )

    def correct_by(self, net: Net) -> GaussianScene:
        """Return the whole simplified scene with its cells corrected by a network."""
        if isinstance(net, MergeNet):
            return self.correct_scene(net(self.descriptors))
        scene, merged = self.reference[:2]
        descriptors = describe_published(scene, merged, self.part, cells=self.cells)
        changed = compose_published(merged, cells=self.cells, residuals=net(descriptors))
        return self._with_cells(changed)

    def correct_scene(self, residuals: Residuals) -> GaussianScene:
        """Return the whole simplified scene with its cells corrected, differentiably."""
        return self._with_cells(self.correct_cells(residuals))

    def _with_cells(self, changed: dict[str, Tensor]) -> GaussianScene:
        merged = self.reference.merged
        return merged.with_tensors(
            {
                name: values.index_copy(0, self.cells, changed[name])
                for name, values in merged.tensors().items()
            },
            {},
        )

    def to(self, device: torch.device) -> "Case":
        """Return the case on a device."""
        parts = self.reference._asdict()
        if parts["scene"].device == device:
            return self
        moved = {name: part.to(device) for name, part in parts.items() if name != "radius"}
        return replace(
            self,
            reference=self.reference._replace(**moved),
            cells=self.cells.to(device),
            descriptors=self.descriptors.to(device),
        )


def describe_case(
    scene_name: str, ratio: float, reference: MergedScene, cells: Int[Tensor, "r"]
) -> Case:
    """Return the case of some cells, with their descriptors."""
    descriptors = describe_cells(
        reference.scene,
        reference.merged,
        reference.partition.select(cells),
        cells=cells,
        neighbors=reference.neighbors[cells],
        sizes=reference.partition.counts,
        visibility=reference.visibility,
        pixel_size=reference.radius / IMAGE_SIZE,
    )
    return Case(
        scene_name=scene_name,
        ratio=ratio,
        reference=reference,
        cells=cells,
        descriptors=descriptors,
    )


def make_case(
    scene_name: str, scene: GaussianScene, ratio: float, config: SimplifyConfig
) -> Case | None:
    """Simplify a scene without a network; None if no cell has several members."""
    target = target_count(len(scene), ratio)
    if target >= len(scene):
        return None
    reference = merge_scene(scene, target, config)
    cells = reference.partition.several()
    return describe_case(scene_name, ratio, reference, cells) if len(cells) else None


Item = TypeVar("Item", Case, ViewImages)


class DeviceCopies:
    """Copies on a device of cases and images, the least recently used of which are evicted."""

    def __init__(self, device: torch.device, room: int | None = None) -> None:
        self.device: torch.device = device
        self._room = room or DEVICE_BYTES
        if room is None and device.type == "cuda":
            self._room = torch.cuda.mem_get_info(device)[0] // 2
        # The originals are kept with the copies, so that their ids are not reused.
        self._copies: OrderedDict[int, tuple[Any, Any]] = OrderedDict()
        self._taken = 0

    def get(self, item: Item) -> Item:
        """Return a copy on the device, or the item itself on a CPU."""
        if self.device.type == "cpu":
            return item
        if id(item) not in self._copies:
            self._taken += _byte_count(item)
            while self._copies and self._taken > self._room:
                self._taken -= _byte_count(self._copies.popitem(last=False)[1][0])
            self._copies[id(item)] = item, item.to(self.device)
        self._copies.move_to_end(id(item))
        copied: Item = self._copies[id(item)][1]
        return copied


def _byte_count(value: Any) -> int:
    """Return the total size of all tensors in a value, bytes."""
    if isinstance(value, Tensor):
        return value.nbytes
    if is_dataclass(value):
        return sum(_byte_count(getattr(value, field.name)) for field in fields(value))
    parts = value.values() if isinstance(value, dict) else value
    return sum(map(_byte_count, parts)) if isinstance(value, (tuple, dict)) else 0


def render_targets(
    scene: GaussianScene, count: int, *, size: int, seed: int, file: Path | None = None
) -> ViewImages:
    """Render a full scene, in both modes, from cameras of a file or mixed views, also blurred."""
    if file is None:
        cameras = mixed_views(scene, count, size=size, seed=seed, sharp=False)
    else:
        cameras = load_cameras(file).spread(count).fitted(size)
        check_seen(scene, cameras, name=f"the scene beside {file}")
    return render_views(scene, cameras.in_both_modes()).to("cpu").half()
