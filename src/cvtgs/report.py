"""SimplifyReport: what was done, what was left out, and what it cost."""

from pkgutil import resolve_name
from typing import NamedTuple

import pydantic
from jaxtyping import Int
from torch import Tensor

from cvtgs.analysis import EffectPlan
from cvtgs.clock import StageCost
from cvtgs.config import SimplifyConfig
from cvtgs.config.base import Record
from cvtgs.scene import GaussianScene


class RefineReport(Record):
    """What a refinement did.

    Attributes:
        steps: Steps that were taken.
        images: Images of the full scene that were rendered to learn from.
        heldout: Views that were held out and decided.
        psnr_before: PSNR of the scene that came in over the held-out views, dB; each counts as
            at most 10 dB more than their median.
        psnr_after: The same of the scene that came out; never less.
        gain: Their difference, dB.
        changed_count: Gaussians that are not what they were.
        stopped: Why it ended: ``steps``, ``time``, ``patience`` (held-out views stopped
            improving), or ``perfect`` (there was nothing to gain).
        backend: What rendered.
        device: Where it ran.
        cost: What it cost, as the stage ``refine``.
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
    cost: StageCost


class MatchReport(Record):
    """What matching merged Gaussians to images of the full scene did.

    Attributes:
        views: Images of the full scene.
        opacities_kept: Whether the matched opacities stayed: they did no harm to every eighth
            image.
        psnr_before: PSNR of the mean squared error of every eighth image (all of fewer than
            eight) before, dB.
        psnr_after: The same afterwards.
        backend: What rendered.
    """

    views: int
    opacities_kept: bool
    psnr_before: float
    psnr_after: float
    backend: str


class CellStatistics(Record):
    """What the filter left out, and what the cells of a tessellation are like.

    Attributes:
        filtered_count: Faint Gaussians and flyaways that were left out of the tessellation.
        filtered_mass_share: Their share of the mass.
        single_member_cells: Cells of one Gaussian, or with one of theirs as representative: it is
            kept as it is.
        largest_cell: Members of the largest cell.
        refilled_cells: Cells that were empty after Lloyd and took a Gaussian from another.
        energies: Energy of the tessellation before every Lloyd iteration, over the Gaussians that
            Lloyd samples, in squared robust radii.
        energy: The same of the final cells, over all Gaussians.
        backend: What searched the nearest site.
    """

    filtered_count: int = 0
    filtered_mass_share: float = 0.0
    single_member_cells: int = 0
    largest_cell: int = 0
    refilled_cells: int = 0
    energies: tuple[float, ...] = ()
    energy: float = 0.0
    backend: str = "none"


class SimplifyReport(CellStatistics):
    """What a simplification did.

    Attributes:
        input_count: Gaussians in, N.
        output_count: Gaussians out.
        target_count: ``ceil(rho * N)``, or the count that was asked for.
        rho: ``target_count / input_count``.
        invalid_rows: Rows that were dropped, by the attribute that is NaN, infinite or zero. A
            row with several bad attributes counts once for each.
        invalid_count: Rows that were dropped.
        shortfall: Why ``output_count`` is below ``target_count``, else empty.
        kept_count: Protected Gaussians, which were kept as they are.
        blocks: Blocks of space that were simplified one by one; 1 for the scene in one piece.
        resumed_blocks: Those of them that were done already when this run started.
        mass_in: Opacity times mean projected area of the input, squared scene units.
        mass_out: The same of the output.
        checkpoint: What corrected the merged Gaussians: a shipped name, a file, or ``none``.
        device: Where it ran.
        device_note: Why it ran elsewhere, or in short chunks: the memory of the chosen device ran
            out; else empty.
        views: Where images of the scene were rendered from: ``N cameras`` that were given or lay
            beside it, ``found`` by cvtgs, or ``none`` without images.
        plan: The effects that the scene called for.
        stages: What each stage cost.
        matching: What matching to images of the scene gained; None if there was none.
        refinement: What a refinement gained afterwards; None if there was none.
        config: The configuration.
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
    config: SimplifyConfig

    @property
    def seconds(self) -> float:
        """Wall-clock seconds of all stages."""
        return sum(stage.seconds for stage in self.stages)

    def __repr__(self) -> str:
        """Return counts, seconds and preset; :meth:`to_json` has the rest."""
        return (
            f"SimplifyReport({self.input_count:,} -> {self.output_count:,} Gaussians, "
            f"{self.seconds:.2f} s, preset {self.config.preset}, checkpoint {self.checkpoint}, "
            f"{self.device})"
        )

    def to_json(self) -> str:
        """Return the report as indented JSON.

        Returns:
            JSON text that ends with a line break.
        """
        return self.model_dump_json(indent=2) + "\n"


class Simplified(NamedTuple):
    """A small scene, and how it was made.

    Attributes:
        scene: The small scene.
        report: Counts, mass, energies, and the cost of every stage.
    """

    scene: GaussianScene
    report: SimplifyReport

    def _repr_html_(self) -> str:
        """Return an image and what was done, for notebooks."""
        text: str = resolve_name("cvtgs.notebooks:result_html")(self)
        return text


class Level(NamedTuple):
    """One size of a scene, of several.

    Attributes:
        scene: The small scene.
        report: What was done, and what it cost beyond what finer sizes had cost already.
        geometric_error: Root mean square distance from Gaussians to the small ones that replace
            them, weighted by apparent mass; scene units.
        nested: Whether every cell consists of whole cells of the finest size.
        assignment: ``(n,)`` row of the small Gaussian that stands for each valid input row, int32;
            -1 for those that were left out. None if all are kept.
    """

    scene: GaussianScene
    report: SimplifyReport
    geometric_error: float
    nested: bool
    assignment: Int[Tensor, "n"] | None = None
