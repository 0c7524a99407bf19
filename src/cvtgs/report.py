"""SimplifyReport and other reports: actions, dropped data and costs of a run."""

import math
from collections.abc import Iterable
from functools import partial
from pkgutil import resolve_name
from typing import Literal, NamedTuple, Self

import pydantic
import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.analysis import EffectPlan
from cvtgs.cameras import Cameras
from cvtgs.clock import StageCost
from cvtgs.config import SimplifyConfig
from cvtgs.config.base import Record
from cvtgs.errors import InvalidArgumentError
from cvtgs.scene import GaussianScene
from cvtgs.text import counted


class RefineReport(Record):
    """Report of a refinement.

    Attributes:
        steps: Number of steps.
        images: Number of images of the full scene that were rendered for training; 0 if those of
            the matching were enough.
        heldout: Number of held-out views, which decide what is kept.
        psnr_before: Mean PSNR of the input scene over the held-out views, dB; each view counts at
            most 10 dB above their median. Of blocks, steps and views are sums, and PSNR are means
            over blocks, in whose images the other blocks do not change.
        psnr_after: The same for the refined scene; never less.
        gain: Difference of the two, dB.
        changed_count: Number of Gaussians that changed.
        stopped: Why the refinement ended: ``steps``, ``time``, ``patience`` (held-out views stopped
            improving), or ``perfect`` (there was nothing to gain).
        backend: Name of the renderer.
        device: Device of the refinement.
        device_note: Why it ended in short chunks, or on another device; empty if it did not.
        cost: Cost of the refinement, as the stage ``refine``.
    """

    steps: int
    images: int
    heldout: int
    psnr_before: float
    psnr_after: float
    gain: float
    changed_count: int
    stopped: str
    backend: str
    device: str
    device_note: str = ""
    cost: StageCost


class MatchReport(Record):
    """Report of matching merged Gaussians to images of the full scene.

    Attributes:
        views: Number of images of the full scene.
        heldout: Number of those that decided and score: every eighth, or all if there are fewer
            than eight. Of blocks, both are sums, although they may share views, and PSNR are means
            over blocks, in whose images the other blocks do not change.
        opacities_kept: Whether the matched opacities were kept, because they lowered the error of
            the held-out images.
        psnr_before: PSNR of the mean squared error of the held-out images before matching, dB.
        psnr_after: The same after matching.
        backend: Name of the renderer.
    """

    views: int
    heldout: int
    opacities_kept: bool
    psnr_before: float
    psnr_after: float
    backend: str


class Tried(Record):
    """A count that a search tried, and its scores over the held-out views.

    Attributes:
        count: Number of Gaussians.
        psnr: Mean PSNR, dB, at most 60 each.
        ssim: Mean SSIM.
        alpha_error: Mean absolute difference of accumulated alpha.
        alpha_bias: Mean signed difference; negative if more of the background shows through.
    """

    count: int
    psnr: float
    ssim: float
    alpha_error: float
    alpha_bias: float


class SearchReport(Tried):
    """Report of a search for the smallest count that reaches a quality: that count, and its scores.

    Attributes:
        metric: Score to reach, PSNR or SSIM.
        target: Its value.
        tried: All counts that were tried, in order.
    """

    metric: Literal["psnr", "ssim"]
    target: float
    tried: tuple[Tried, ...]


class CellStatistics(Record):
    """Statistics of the filter and of the cells.

    Attributes:
        filtered_count: Number of faint Gaussians and flyaways that the filter dropped.
        filtered_mass_share: Share of the mass of the scene that these hold.
        single_member_cells: Number of cells that keep one Gaussian unchanged: their only member,
            or a representative.
        largest_cell: Number of members of the largest cell.
        refilled_cells: Number of cells of the tessellation that were empty after Lloyd and took a
            Gaussian from another.
        energies: Energy of the tessellation before every Lloyd iteration, over the Gaussians that
            Lloyd samples, in squared robust radii.
        energy: Energy of the tessellation, over all Gaussians, before pairs of its cells merge. 0
            if it has a cell for each Gaussian (``standard`` above a ratio of 0.031).
        backend: Name of the nearest-site search.
    """

    filtered_count: int = 0
    filtered_mass_share: float = 0.0
    single_member_cells: int = 0
    largest_cell: int = 0
    refilled_cells: int = 0
    energies: tuple[float, ...] = ()
    energy: float = 0.0
    backend: str = "none"

    def in_larger(self, mass: float | Tensor, whole: float | Tensor) -> Self:
        """Return the statistics of a part of a scene, given its mass, as those of the scene."""
        share = float(mass) / (float(whole) or 1.0) * self.filtered_mass_share
        return self.model_copy(update={"filtered_mass_share": share})


class SimplifyReport(CellStatistics):
    """Report of a simplification, with the statistics of :class:`CellStatistics`.

    Attributes:
        input_count: Number of input Gaussians, N.
        output_count: Number of output Gaussians.
        target_count: ``ceil(rho * N)``, or the requested count.
        rho: ``target_count / input_count``.
        invalid_rows: Number of dropped rows, by the attribute that is NaN, infinite or zero. A row
            with several bad attributes counts once for each.
        invalid_count: Number of dropped rows.
        shortfall: Why ``output_count`` is below ``target_count``; empty if it is not.
        kept_count: Number of protected Gaussians, which stay unchanged.
        blocks: Number of spatial blocks that were simplified one by one; 1 without blocks.
        resumed_blocks: Number of blocks that were already done when this run started.
        mass_in: Opacity times mean projected area of the input, squared scene units.
        mass_out: The same for the output.
        checkpoint: Checkpoint that corrected the merged Gaussians: a shipped name, a file, or
            ``none``.
        device: Device of the run.
        device_note: Says if the chosen device ran out of memory, and whether the run then used
            short chunks or the CPU; else empty.
        views: Origin of the views of rendered images: ``N cameras`` that were given or found with
            the file, ``found`` by cvtgs, or ``none`` without images.
        plan: The effects that the scene called for.
        stages: Cost of each stage; of a search for the count, the sum over all counts it tried.
        matching: Report of the matching to images; None if there was none.
        refinement: Report of the refinement; None if there was none.
        search: Report of the search for the count; None if it was given.
        config: The configuration.
        version: Version of cvtgs that made the result.
        torch_version: Version of torch, with its build; others may round differently.
    """

    input_count: int
    output_count: int
    target_count: int
    rho: float
    invalid_rows: dict[str, int] = pydantic.Field(default_factory=dict)
    invalid_count: int = 0
    shortfall: str = ""
    kept_count: int = 0
    blocks: int = 1
    resumed_blocks: int = 0
    mass_in: float = 0.0
    mass_out: float = 0.0
    checkpoint: str = "none"
    device: str = "cpu"
    device_note: str = ""
    views: str = "none"
    plan: EffectPlan | None = None
    stages: tuple[StageCost, ...] = ()
    matching: MatchReport | None = None
    refinement: RefineReport | None = None
    search: SearchReport | None = None
    config: SimplifyConfig
    version: str = pydantic.Field(default_factory=partial(resolve_name, "cvtgs:__version__"))
    torch_version: str = str(torch.__version__)

    __hash__ = None  # type: ignore[assignment]  # compared by value, and has a dictionary

    @property
    def seconds(self) -> float:
        """Wall-clock seconds of all stages."""
        return sum(stage.seconds for stage in self.stages)

    def __repr__(self) -> str:
        """Return counts, seconds and preset; :meth:`to_json` has the rest."""
        return (
            f"SimplifyReport({self.input_count:,} -> {counted(self.output_count, 'Gaussian')}, "
            f"{self.seconds:.2f} s, preset {self.config.preset}, checkpoint {self.checkpoint}, "
            f"{self.device})"
        )

    __str__ = __repr__


class Simplified(NamedTuple):
    """A simplified scene and its report.

    Attributes:
        scene: The small scene.
        report: Counts, mass, energies, and the cost of every stage.
    """

    scene: GaussianScene
    report: SimplifyReport

    def _repr_html_(self) -> str:
        """Return HTML with an image and facts, for notebooks."""
        text: str = resolve_name("cvtgs.notebooks:result_html")(self)
        return text


def origin_of_views(cameras: Cameras | None) -> str:
    """Return the origin of rendered views: given cameras, or views that were generated."""
    return "found" if cameras is None else counted(len(cameras), "camera")


def check_one_scene(counts: Iterable[int]) -> None:
    """Check that levels are of one scene, by the number of its Gaussians that each states."""
    sizes = sorted(set(counts))
    if len(sizes) > 1:
        raise InvalidArgumentError(
            f"levels must be of one scene, found scenes of {sizes[0]:,} and {sizes[1]:,} Gaussians."
        )


def rms_error(sums: Float[Tensor, "2 m"]) -> float:
    """Return the root mean square distance of Gaussians, given the ``error_sums`` of a level."""
    mass, squares = sums.numpy().sum(axis=1).tolist()  # by one thread, so always the same digits
    return math.sqrt(squares / mass) if mass > 0.0 else 0.0


class Level(NamedTuple):
    """One of several levels of a scene.

    Attributes:
        scene: The small scene.
        report: Report of the level; costs exclude the work shared with finer levels.
        geometric_error: Root mean square distance from Gaussians to the small ones that replace
            them, weighted by apparent mass; scene units.
        assignment: ``(n,)`` row of the small Gaussian that represents each input row, int32, on the
            CPU; -1 for invalid and dropped rows. None if all rows are kept unchanged.
        error_sums: ``(2, m)`` apparent mass that each small Gaussian replaces, and its sum of mass
            times squared distance, float64, on the CPU: ``geometric_error`` is the root of the
            quotient of their totals, and parts of a level have errors of their own. None if all
            valid rows are kept.
    """

    scene: GaussianScene
    report: SimplifyReport
    geometric_error: float
    assignment: Int[Tensor, "n"] | None = None
    error_sums: Float[Tensor, "2 m"] | None = None

    def __repr__(self) -> str:
        """Return scene, report and error, not the tensors."""
        return f"Level({self.scene!r}, {self.report!r}, error {self.geometric_error:.3g})"
