"""Define your own cells: they never span several labels, so objects stay separate.

python examples/custom_cells.py labelled.ply small.ply --column label --rho 0.05

The stages are functions. This example adds a coordinate to the space of the tessellation, so that
Gaussians of different labels are far apart. Each cell is merged by moments.
"""

import argparse
from pathlib import Path

import torch

import cvtgs
from cvtgs.config import SimplifyConfig
from cvtgs.math.frames import morton_order, robust_frame

APART = 1e3
"""Distance between labels in robust radii, larger than any distance in the scene."""


def main() -> None:
    """Read, simplify all labels in one pass, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("input", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--column", default="label", help="an extra column of the file")
    parser.add_argument("--rho", type=float, default=0.05)
    options = parser.parse_args()
    scene = cvtgs.validity.check_rows(cvtgs.load(options.input)).scene
    if not scene.extras:
        parser.error(f"{options.input} must have an extra column of labels, found none")
    if options.column not in scene.extras:
        parser.error(f"--column must be one of {list(scene.extras)}, found {options.column!r}")
    cvtgs.save(merge_within(scene, scene.extras[options.column], options.rho), options.output)


def merge_within(
    scene: cvtgs.GaussianScene, labels: torch.Tensor, rho: float
) -> cvtgs.GaussianScene:
    """Simplify a scene of valid rows; labels with enough mass for a cell never share one."""
    config, frame = SimplifyConfig.from_preset("standard"), robust_frame(scene.means)
    order = morton_order(frame.contract(scene.means))
    scene, labels = scene.select(order), labels[order]
    places = cvtgs.cvt.embed(scene.means, scene.sh0, frame=frame, color=0.05)
    points = torch.cat([places, APART * labels[:, None].to(places.dtype)], dim=1)
    count = cvtgs.target_count(len(scene), rho)
    cells = cvtgs.cvt.tessellate(points, scene.masses, count, config=config.cvt)
    partition = cvtgs.cells.Partition.from_labels(cells.labels, count)
    return cvtgs.cells.merge_cells(scene, partition, config=config.merge)


if __name__ == "__main__":
    main()
