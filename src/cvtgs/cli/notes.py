"""Sentences that ``cvtgs simplify`` prints besides counts, sizes and seconds."""

from typing import TYPE_CHECKING

from cvtgs.text import counted

if TYPE_CHECKING:
    from cvtgs.budget import Found
    from cvtgs.config import SimplifyConfig
    from cvtgs.report import SimplifyReport


def target_note(found: "Found", config: "SimplifyConfig", *, is_given: bool) -> str:
    """Return the scores of a search, and the views that they are measured over."""
    views = "the given cameras" if is_given else "automatic views"
    if config.uses_images:
        views = "automatic views that it was not fitted to"
    return (
        f"PSNR {found.psnr:.2f} dB, SSIM {found.ssim:.4f}, alpha error {found.alpha_error:.4f} "
        f"(bias {found.alpha_bias:+.4f}) over {views}; found in {len(found.tried)} tries."
    )


def report_notes(report: "SimplifyReport") -> list[str]:
    """Return the sentences to print besides counts, sizes and seconds."""
    notes = []
    if report.device_note:
        notes.append(f"{report.device_note}.")
    if report.blocks > 1:
        resumed = (
            f", {report.resumed_blocks} of them from an earlier run"
            if report.resumed_blocks
            else ""
        )
        notes.append(f"In {report.blocks} blocks{resumed}.")
    if report.shortfall:
        notes.append(f"Fewer than the requested {report.target_count:,}: {report.shortfall}.")
    if report.matching is not None:
        from cvtgs.matching import heldout_rows

        matched = report.matching
        each = matched.views // report.blocks  # every block has held-out images of its own
        where = "every eighth of them" if heldout_rows(each) else "the same images"
        notes.append(
            f"Matched to {matched.views} images of the scene: "
            f"{matched.psnr_after - matched.psnr_before:+.2f} dB on {where}."
        )
    if report.refinement is not None:
        refined = report.refinement
        steps = counted(refined.steps, "step")
        if refined.stopped == "time" and refined.steps == 0:
            notes.append(
                f"Not refined: rendering {counted(refined.heldout, 'held-out image')} first took "
                f"{refined.cost.seconds:.1f} s and left no time for a step; allow more time "
                "(--refine), or fewer or smaller images (--set refine.heldout, --set refine.size)."
            )
        elif refined.gain == 0.0 and refined.stopped != "perfect":
            notes.append(f"Not refined: none of {steps} improved the held-out images.")
        else:
            notes.append(f"Refined in {steps}: {refined.gain:+.2f} dB on held-out images.")
    return notes
