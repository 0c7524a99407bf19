"""What each part of CVT-GS is worth: the paper's ablation table, for both configurations.

``python -m benchmarks.ablation -o docs`` leaves out one part at a time of ``paper`` and of
``standard``, each with its network, and prints PSNR, SSIM and LPIPS against the full scene as
Markdown; the folder gets that and a chart of the means, anew after every scene. Scenes and judges
are those of ``benchmarks.quality``: name files, give ``--lpips WEIGHTS`` or ``--scorer COMMAND``.

- w/o CVT: k-NN groups (``benchmarks.grouping``) instead of the tessellation; filter, merge,
  inflation and network stay.
- w/o filter: every valid Gaussian enters the tessellation.
- w/o MergeNet: merged by moments (and inflation) alone.
- full: ``Simplifier("paper")`` and ``Simplifier("standard")``.
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

import cvtgs
from benchmarks.grouping import grouped_simplifier
from benchmarks.scoring import (
    SIZE,
    VIEWS,
    Quality,
    Simplify,
    Table,
    configuration,
    markdown,
    means,
    measure,
    scoring_parser,
)
from cvtgs.io import atomic_output
from cvtgs.mergenet import load_checkpoint
from cvtgs.plots import Panel, Series, line_chart

PRESETS = ("paper", "standard")
PARTS = ("w/o CVT", "w/o filter", "w/o MergeNet", "full")
WITHOUT_FILTER = {"filter.max_mass_share": "0", "filter.max_flyaway_share": "0"}
METRICS = {"psnr": "PSNR, dB", "ssim": "SSIM", "lpips": "LPIPS (less is better)"}


def main(arguments: Sequence[str] | None = None) -> None:
    parser = scoring_parser(__doc__)
    parser.add_argument("-o", "--output", type=Path, help="folder for ablation.md and ablation.png")
    options = parser.parse_args(arguments)
    text = ""
    for table in measure(variants(options), options):
        text = report(table, options)
        if options.output is not None:
            write(options.output, "ablation.md", text.encode())
            write(options.output, "ablation.png", chart(means(table), options.rho))
    print(text)


def variants(options: argparse.Namespace) -> dict[str, Simplify]:
    """Return every row of the table: both presets, each in full and without each part."""
    rows: dict[str, Simplify] = {}
    for preset in PRESETS:
        config = configuration(options, {"preset": preset})
        unfiltered = configuration(options, {"preset": preset, **WITHOUT_FILTER})
        net = load_checkpoint(preset).net if config.merge.network else None
        parts: tuple[Simplify, ...] = (
            grouped_simplifier(config, net),
            cvtgs.Simplifier(preset, config=unfiltered).simplify,
            cvtgs.Simplifier(None, config=config).simplify,
            cvtgs.Simplifier(preset, config=config).simplify,
        )
        rows |= {row(preset, part): each for part, each in zip(PARTS, parts, strict=True)}
    return rows


def row(preset: str, part: str) -> str:
    return f"{preset}, {part}"


def report(table: Table, options: argparse.Namespace) -> str:
    """Report what was measured, then how it came out."""
    images = f"cvtgs' own renderer, {VIEWS} automatic views of {SIZE} x {SIZE} pixels"
    scenes = "FILES" if options.files else f"--count {options.count}"
    nets = ", ".join(f"{name} {described(name)}" for name in PRESETS)
    return (
        "# Ablation\n\n"
        f"`python -m benchmarks.ablation {scenes} -o FOLDER` makes this table (with "
        "`--lpips WEIGHTS` for LPIPS).\n\n"
        f"Scenes: {', '.join(table)}. "
        f"Judge: {'the command of --scorer' if options.scorer else images}. "
        f"cvtgs {cvtgs.__version__}, checkpoints: {nets}.\n\n"
        f"{markdown(table, options.rho, means_only=options.means)}"
    )


def described(name: str) -> str:
    checkpoint = load_checkpoint(name)
    return f"{checkpoint.digest[:12]} ({checkpoint.info.steps} steps)"


def chart(averages: Mapping[str, Sequence[Quality]], ratios: Sequence[float]) -> bytes:
    """Draw the means over the ratio: a row of panels per metric, a column per preset."""
    measured = {
        field: label
        for field, label in METRICS.items()
        if all(
            getattr(quality, field) is not None for found in averages.values() for quality in found
        )
    }
    panels = [
        Panel(
            series=[
                Series(
                    name=part,
                    x=ratios,
                    y=[getattr(quality, field) for quality in averages[row(preset, part)]],
                    markers=True,
                )
                for part in PARTS
            ],
            title=preset,
            x_label="share of Gaussians kept",
            y_label=label,
            x_ticks=ratios,
            log_x=True,
        )
        for field, label in measured.items()
        for preset in PRESETS
    ]
    height = 360 * len(measured)
    return line_chart(panels, columns=len(PRESETS), share_y=True, width=1000, height=height)


def write(folder: Path, name: str, content: bytes) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_output(folder / name, overwrite=True) as file:
        file.write(content)


if __name__ == "__main__":
    main()
