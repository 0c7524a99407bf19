"""Cells on a slice of a generated object: ``python -m docs.drawings.cells docs/images/cells.png``.

Left: the Gaussians of a thin horizontal slice, as large as their mean standard deviation and as
opaque as they are. Right: the same dots in the colours of their cells, the sites within the slice,
and the borders of the cells where the middle of the slice cuts them.
"""

import argparse
from pathlib import Path

import matplotlib as mpl
import torch
from matplotlib.axes import Axes

import cvtgs
from cvtgs.analysis import perspective_falloff
from cvtgs.config import SimplifyConfig
from cvtgs.math.frames import morton_order, robust_frame
from docs.drawings.saving import figure, save_small

HEIGHT, THICKNESS = -0.28, 0.03
WINDOW = (-1.3, 0.55, -0.72, 0.72)
PIXELS = 700


def main() -> None:
    """Draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", type=Path)
    options = parser.parse_args()
    scene = cvtgs.synthetic.scene("object", 80_000, sh_degree=0, seed=4)
    config = SimplifyConfig.from_preset("standard").cvt
    frame = robust_frame(scene.means)
    order = morton_order(frame.contract(scene.means))
    # By position alone and uncontracted, so that straight borders are what the method sees.
    points = cvtgs.cvt.embed(scene.means[order], frame=frame)
    seen = scene.areas[order] * perspective_falloff(frame.distances(scene.means[order]))
    weights = cvtgs.cvt.tessellation_weights(
        scene.opacities[order], seen, area_power=1.0, floor=config.weight_floor
    )
    cells = cvtgs.cvt.tessellate(points, weights, 1_000, config=config)
    sites = cells.sites * frame.radius + frame.center
    canvas, (left, right) = figure(1, 2, width=10.4, height=4.5)
    scene, labels = scene.select(order), cells.labels
    rows = ((scene.means[:, 1] - HEIGHT).abs() < THICKNESS).nonzero()[:, 0]
    rows = rows[(scene.scales[rows].mean(dim=1) < 0.3) & (scene.opacities[rows] > 0.1)]
    colors = (0.5 + 0.282 * scene.sh0[rows, 0]).clamp(0, 1)
    palette = torch.tensor(mpl.colormaps["tab20"](range(20)))[:, :3]
    shuffled = palette[(labels[rows] * 7919) % 20]
    draw_dots(left, scene, rows, colors)
    draw_dots(right, scene, rows, shuffled)
    draw_borders(right, sites)
    near = (sites[:, 1] - HEIGHT).abs() < THICKNESS
    right.scatter(sites[near, 0], sites[near, 2], s=9, c="black", linewidths=0)
    left.set_title("Gaussians of a slice, from above")
    right.set_title("their cells: sites (black) and borders")
    save_small(canvas, options.output)


def draw_dots(
    axes: Axes, scene: cvtgs.GaussianScene, rows: torch.Tensor, colors: torch.Tensor
) -> None:
    """Draw Gaussians as dots."""
    sizes = (scene.scales[rows].mean(dim=1) * 300).square().clamp(2.0, 160.0)
    alphas = (0.15 + 0.65 * scene.opacities[rows])[:, None]
    x, z = scene.means[rows, 0], scene.means[rows, 2]
    axes.scatter(x, z, s=sizes, c=torch.cat([colors, alphas], dim=1), linewidths=0)
    axes.set(xlim=WINDOW[:2], ylim=WINDOW[2:], aspect="equal", xticks=[], yticks=[])


def draw_borders(axes: Axes, sites: torch.Tensor) -> None:
    """Draw where the plane in the middle of the slice changes from one cell to the next."""
    x, z = torch.linspace(*WINDOW[:2], PIXELS), torch.linspace(*WINDOW[2:], PIXELS)
    grid = torch.stack(torch.meshgrid(x, z, indexing="ij"), dim=2).reshape(-1, 2)
    plane = torch.stack([grid[:, 0], torch.full((len(grid),), HEIGHT), grid[:, 1]], dim=1).double()
    labels, _ = cvtgs.cvt.nearest_scipy(plane, sites)
    image = labels.reshape(PIXELS, PIXELS).T
    border = torch.zeros_like(image, dtype=torch.float32)
    border[:, 1:] += (image[:, 1:] != image[:, :-1]).float()
    border[1:] += (image[1:] != image[:-1]).float()
    ink = torch.zeros(PIXELS, PIXELS, 4)
    ink[..., 3] = border.clamp(0, 1) * 0.55
    axes.imshow(ink, extent=WINDOW, origin="lower", aspect="equal", interpolation="bilinear")


if __name__ == "__main__":
    main()
