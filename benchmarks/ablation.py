"""The paper's ablation table, for both configurations: the gain of each part of CVT-GS.

``python -m benchmarks.ablation -o FOLDER`` omits one part at a time of ``paper`` and of
``standard``, each with its network, and prints PSNR, SSIM and LPIPS against the full scene as
Markdown. The folder gets this table and a chart of the means, updated after every scene. Scenes and
scorers are chosen as in ``benchmarks.quality``: name files, give ``--lpips WEIGHTS`` or ``--scorer
COMMAND``.

- w/o CVT: k-NN groups instead of the tessellation; filter, merge, inflation and network stay.
- w/o filter: every valid Gaussian enters the tessellation.
- w/o MergeNet: merged by moments (and inflation) alone.
- full: ``Simplifier("paper")`` and ``Simplifier("standard")``.
- our network: the cells of ``paper`` with a network of the design of ``standard``, trained on them
  (``benchmarks/paper-gated.safetensors``). It shows the effect of design and training alone.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor

import cvtgs
from benchmarks.measuring import write_file
from benchmarks.quality import (
    Quality,
    Simplify,
    Table,
    configuration,
    judge_of,
    markdown,
    means,
    measure,
    scoring_parser,
)
from cvtgs import cells
from cvtgs.analysis.effects import CLAMPED, mean_clamped
from cvtgs.errors import MissingDependencyError
from cvtgs.mergenet import MergeNet, PublishedMergeNet, correct_cells, load_checkpoint
from cvtgs.pipeline import merge_and_inflate
from cvtgs.plots import Panel, Series, line_chart
from cvtgs.train.cases import MergedScene, merge_scene
from cvtgs.validity import standardized, valid_part

PRESETS = ("paper", "standard")
PARTS = ("w/o CVT", "w/o filter", "w/o MergeNet", "full")
OUR_NETWORK = "our network"
GATED = Path(__file__).with_name("paper-gated.safetensors")
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
            write_file(options.output / "ablation.md", text.encode())
            try:
                write_file(options.output / "ablation.png", chart(means(table), options.rho))
            except MissingDependencyError as error:
                print(f"without a plot: {error}", file=sys.stderr)
    print(text)


def variants(options: argparse.Namespace) -> dict[str, Simplify]:
    """Return the simplifier of every row: both presets, in full and without each part."""
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
        if preset == "paper" and config.merge.network:
            rows[row(preset, OUR_NETWORK)] = cvtgs.Simplifier(GATED, config=config).simplify
    return rows


def row(preset: str, part: str) -> str:
    return f"{preset}, {part}"


def report(table: Table, options: argparse.Namespace) -> str:
    """Return the report: the settings of the measurement, then the results."""
    scenes = "FILES" if options.files else f"--count {options.count}"
    nets = ", ".join(
        [f"{name} {described(name)}" for name in PRESETS]
        + [f"our network of paper {described(GATED)}"]
    )
    return (
        "# Ablation\n\n"
        f"`python -m benchmarks.ablation {scenes} -o FOLDER` makes this table (with "
        "`--lpips WEIGHTS` for LPIPS).\n\n"
        f"Scenes: {', '.join(table)}. "
        f"Judge: {judge_of(options, options.files)}. "
        f"cvtgs {cvtgs.__version__}, checkpoints: {nets}.\n\n"
        f"{markdown(table, options.rho, means_only=options.means)}"
    )


def described(name: str | Path) -> str:
    checkpoint = load_checkpoint(name)
    return f"{checkpoint.digest[:12]} ({checkpoint.info.steps} steps)"


def chart(averages: Mapping[str, Sequence[Quality]], ratios: Sequence[float]) -> bytes:
    """Plot the means over the ratio: a row of panels per metric, a column per preset."""
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
                for part in (*PARTS, OUR_NETWORK)
                if row(preset, part) in averages
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


def nearest_groups(points: Float[Tensor, "n d"], count: int, *, seed: int) -> Int[Tensor, "n"]:
    """Group points around random seeds: each seed takes its nearest free points.

    Seeds are drawn uniformly, without replacement. In the order of the draw each takes the
    ``floor(n / count) - 1`` points nearest to it that are neither a seed nor taken. The remaining
    points, fewer than ``count``, join their nearest seed. There are no weights, colours or
    iterations. Groups have nearly equal sizes; late ones are not compact, since points near them
    are already taken. Memory: two k-d trees, some ``150 n`` bytes.

    The paper calls this alternative to the tessellation "k-NN grouping"; the algorithm is our
    interpretation of the name.

    Args:
        points: Positions.
        count: Number of groups, 1 to n.
        seed: Seed of the draw.

    Returns:
        Group of every point, 0 to ``count - 1``; no group is empty.

    Example:
        >>> nearest_groups(torch.tensor([[0.0], [1.0], [9.0], [8.0]]), 2, seed=1).tolist()
        [0, 0, 1, 1]
    """
    places = points.double().numpy()
    draw = torch.randperm(len(points), generator=torch.Generator().manual_seed(seed))
    seeds = draw[:count].numpy()
    labels = np.full(len(points), -1)
    labels[seeds] = np.arange(count)
    wanted = len(points) // count - 1
    rows = np.arange(len(points))
    tree = KDTree(places)
    taken = count
    for group, place in enumerate(places[seeds]) if wanted else ():
        # Queries stay cheap as long as at least half of the tree is free.
        if 2 * (len(points) - taken) < len(rows):
            rows = rows[labels[rows] < 0]
            tree = KDTree(places[rows])
        labels[nearest_free(tree, rows, place, labels=labels, count=wanted)] = group
        taken += wanted
    left = (labels < 0).nonzero()[0]
    labels[left] = KDTree(places[seeds]).query(places[left])[1]
    return torch.from_numpy(labels)


def nearest_free(
    tree: KDTree, rows: np.ndarray, place: np.ndarray, *, labels: np.ndarray, count: int
) -> np.ndarray:
    """Find the nearest rows of a tree that have no label, by growing the search."""
    looked_at = 2 * count
    while True:
        looked_at = min(looked_at, len(rows))
        found = rows[np.atleast_1d(tree.query(place, k=looked_at)[1])]
        free: np.ndarray = found[labels[found] < 0]
        if len(free) >= count or looked_at == len(rows):
            return free[:count]
        looked_at *= 2


def grouped_simplifier(
    config: cvtgs.SimplifyConfig, net: MergeNet | PublishedMergeNet | None
) -> Simplify:
    """Return a simplifier with k-NN groups instead of the tessellation, otherwise as configured."""

    def simplify(scene: cvtgs.GaussianScene, rho: float) -> cvtgs.GaussianScene:
        count, valid = cvtgs.target_count(len(scene), rho), valid_part(scene)
        if count >= len(valid):
            return standardized(valid)  # there is nothing to group
        all_members = config.merge.model_copy(update={"representatives": False})
        whole = config.model_copy(update={"merge": all_members})
        reference = merge_scene(scene, count, whole)
        rows = reference.partition.order.sort().values  # those that passed the filter
        labels = nearest_groups(reference.scene.means[rows], count, seed=config.seed)
        local = cells.Partition.from_labels(labels, count)
        partition = cells.Partition(order=rows[local.order], offsets=local.offsets)
        return regroup(reference, partition, config, net=net)

    return simplify


def regroup(
    reference: MergedScene,
    partition: cells.Partition,
    config: cvtgs.SimplifyConfig,
    *,
    net: MergeNet | PublishedMergeNet | None,
) -> cvtgs.GaussianScene:
    """Merge, inflate and correct the cells of any grouping, as the pipeline does.

    With the partition of the reference itself, the result is that of ``Simplifier``.
    """
    scene = reference.scene
    merged = merge_and_inflate(
        scene,
        partition,
        config.merge,
        areas=scene.areas,
        clamping=config.effects.clamping != "off"
        and bool(mean_clamped(scene, scene.masses) > CLAMPED),
        with_network=net is not None and net.sees_surroundings,
    )
    if net is None:
        return standardized(merged.scene)
    corrected = correct_cells(
        net,
        scene,
        merged.scene,
        merged.partition,
        neighbors=merged.neighbors,
        visibility=reference.visibility,
        pixel_size=reference.radius / config.merge.image_size,
    )
    return standardized(corrected)


if __name__ == "__main__":
    main()
