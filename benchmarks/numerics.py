"""Measure numerics on hard scenes: condition, residuals, float32 against float64, and time.

``python -m benchmarks.numerics -o docs/numerics.md`` updates the tables of that page, from the
catalogue in ``tests/hard_cases.py``.
"""

import argparse
import sys
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

import cvtgs
from benchmarks.measuring import around_tables, fastest, machine, renew_tables
from cvtgs import GaussianScene, Simplifier, SimplifyConfig
from cvtgs.cells import Partition, merge_cells
from cvtgs.cells.merge import gather_members, mean_and_covariance
from cvtgs.config import MergeConfig
from cvtgs.cvt import embed, nearest_neighbors, tessellate
from cvtgs.math import parameters
from cvtgs.math.frames import morton_order, robust_frame
from cvtgs.mergenet import correct_cells
from cvtgs.validity import valid_part
from cvtgs.views import automatic_views

COUNT = 2000
TIMED = 20_000
Cases = Mapping[str, Callable[[int, torch.dtype], GaussianScene]]


class Figures(NamedTuple):
    """One row of the table; errors are those of float32 against float64."""

    condition: float
    residual: float
    energy: float
    means: float
    matrices: float
    opacities: float
    colors: float
    network: float
    images: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, help="page whose tables are updated")
    parser.add_argument(
        "--case", nargs="+", choices=catalogue(), help="cases to measure; all by default"
    )
    parser.add_argument("--count", type=int, default=COUNT)
    parser.add_argument(
        "--timed", type=int, default=TIMED, help="Gaussians of the timed scenes; 0 for no times"
    )
    options = parser.parse_args()
    if options.output is not None and (options.case is not None or not options.timed):
        parser.error("-o replaces both tables, so it needs all cases and times.")
    if options.output is not None:
        around_tables(options.output, script="benchmarks.numerics")
    cases = {name: make for name, make in catalogue().items() if name in (options.case or [name])}
    text = error_table(cases, options.count)
    if options.timed:
        text += "\n" + time_table(cases, options.timed)
    if options.output is None:
        print(text)
    else:
        renew_tables(options.output, text, script="benchmarks.numerics")


def catalogue() -> Cases:
    """Load the hard cases of the tests."""
    sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
    from hard_cases import CASES  # noqa: PLC0415 (found there only)

    cases: Cases = CASES
    return cases


def error_table(cases: Cases, count: int) -> str:
    names = Figures._fields
    lines = ["| case | " + " | ".join(names) + " |", "|---" * (len(names) + 1) + "|"]
    lines += [
        f"| {name} | " + " | ".join(f"{value:.0e}" for value in figures(make, count)) + " |"
        for name, make in cases.items()
    ]
    return "\n".join(lines) + "\n"


def time_table(cases: Cases, count: int) -> str:
    """Return a table of CPU seconds at rho 0.1, and their ratio to those of the easy scene."""
    easy = {preset: cpu_seconds(catalogue()["ball"], count, preset) for preset in PRESETS}
    lines = [f"{machine()}; {count:,} Gaussians to a tenth, the faster of two runs, CPU seconds.\n"]
    lines += ["| case | " + " | ".join(f"{p} | / ball" for p in PRESETS) + " |"]
    lines += ["|---" * (2 * len(PRESETS) + 1) + "|"]
    for name, make in cases.items():
        cells = []
        for preset in PRESETS:
            seconds = easy[preset] if name == "ball" else cpu_seconds(make, count, preset)
            cells += [f"{seconds:.2f}", f"{seconds / easy[preset]:.1f}"]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


PRESETS = ("standard", "paper")


def cpu_seconds(
    make: Callable[[int, torch.dtype], GaussianScene], count: int, preset: str
) -> float:
    scene, simplifier = make(count, torch.float32), Simplifier(config=preset, device="cpu")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about dropped rows
        return fastest(lambda: simplifier.simplify(scene, 0.1), runs=2)


def figures(make: Callable[[int, torch.dtype], GaussianScene], count: int) -> Figures:
    """Run the stages on one scene in both precisions, with the cells of float64."""
    single = valid_part(make(count, torch.float32))
    double = in_float64(single)
    target = max(1, len(single) // 10)
    labels, energy = grouped(double, target)
    part = Partition.from_labels(labels, target)
    config = SimplifyConfig().merge
    first, second = (merge_cells(scene, part, config=config) for scene in (double, single))
    wanted = exact_covariances(double, part, config.area_power)
    size = wanted.abs().amax(dim=(1, 2))
    place = (second.means.double() - first.means).norm(dim=1) / size.sqrt()
    neighbors = nearest_neighbors(first.means, 8)
    corrected = corrected_scales(double, first, part, neighbors)
    approximate = corrected_scales(single, second, part, neighbors)
    return Figures(
        condition=float(
            torch.exp(2 * (first.log_scales.amax(1) - first.log_scales.amin(1))).amax()
        ),
        residual=worst((matrices_of(first) - wanted).abs().amax(dim=(1, 2)) / size),
        energy=abs(grouped(single, target)[1] - energy) / (energy or 1.0),
        means=worst(place),
        matrices=worst((matrices_of(second) - matrices_of(first)).abs().amax(dim=(1, 2)) / size),
        opacities=worst((second.opacities.double() - first.opacities).abs()),
        colors=worst((second.sh - first.sh).abs() / (1 + first.sh.abs().amax())),
        network=worst((approximate - corrected).abs()),
        images=image_error(first, second),
    )


def in_float64(scene: GaussianScene) -> GaussianScene:
    return scene.with_tensors({k: v.double() for k, v in scene.tensors().items()}, {})


def grouped(scene: GaussianScene, target: int) -> tuple[Tensor, float]:
    """Group by position alone; return labels in row order, and the energy."""
    points = embed(scene.means, frame=robust_frame(scene.means), contraction=1.0)
    order = morton_order(points, ties=scene.masses)
    weights = torch.ones(len(scene), dtype=torch.float64)
    found = tessellate(points[order], weights, target, config=SimplifyConfig().cvt)
    labels = torch.empty_like(found.labels)
    labels[order] = found.labels
    return labels, found.energy


def exact_covariances(scene: GaussianScene, part: Partition, power: float) -> Tensor:
    """Return merged covariances in float64, before decomposition into scales and rotations."""
    members = gather_members(scene, part)
    return mean_and_covariance(members, members.weights(power))[1]


def matrices_of(scene: GaussianScene) -> Tensor:
    quats = parameters.normalize_quats(scene.quats.double())
    return parameters.build_covariances(torch.exp(scene.log_scales.double()), quats)


def corrected_scales(
    scene: GaussianScene, merged: GaussianScene, part: Partition, neighbors: Tensor
) -> Tensor:
    net = Simplifier(device="cpu").checkpoint.net.to(scene.dtype)  # type: ignore[union-attr]
    light = torch.ones(len(scene), dtype=torch.float64)
    pixel_size = robust_frame(scene.means).radius / MergeConfig().image_size
    small = correct_cells(
        net, scene, merged, part, neighbors=neighbors, visibility=light, pixel_size=pixel_size
    )
    return small.log_scales.double()


def image_error(first: GaussianScene, second: GaussianScene) -> float:
    cameras = automatic_views(second, 2, width=64, height=64)
    ours, theirs = (cvtgs.render(scene, cameras).rgb.double() for scene in (first, second))
    return worst((ours.clamp(0, 1) - theirs.clamp(0, 1)).abs())


def worst(values: Tensor) -> float:
    return float(values.amax()) if values.numel() else 0.0


if __name__ == "__main__":
    main()
