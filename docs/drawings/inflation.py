"""Inflation: ``python -m docs.drawings.inflation docs/images/inflation.png``.

Left: a row of opaque members in one dimension, what they paint together, and what the merged
Gaussians of two cells paint with their moments and inflated. Right: a generated object with
moments only and inflated, over white, so that gaps show.
"""

import argparse
from pathlib import Path

import torch
from matplotlib.axes import Axes

import cvtgs
from cvtgs.cameras import Cameras, look_at
from cvtgs.config import SimplifyConfig
from docs.drawings.saving import figure, save_small

MEMBERS, WIDTH, OPACITY = 24, 0.05, 0.8
SIZE = 360


def main() -> None:
    """Draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", type=Path)
    options = parser.parse_args()
    canvas, (left, middle, right) = figure(1, 3, width=10.4, height=3.7)
    draw_profile(left)
    for axes, inflated in ((middle, False), (right, True)):
        axes.imshow(render_object(inflated=inflated))
        axes.set(xticks=[], yticks=[])
        axes.set_title("inflated" if inflated else "moments only: gaps")
    save_small(canvas, options.output)


def draw_profile(axes: Axes) -> None:
    """Draw what is painted along a line that two cells share."""
    x = torch.linspace(-1.3, 1.3, 600)
    centers = torch.linspace(-1, 1, MEMBERS)
    together = 1 - (1 - bells(x, centers, WIDTH, OPACITY)).prod(dim=0)
    halves = centers.chunk(2)
    middles = torch.stack([half.mean() for half in halves])
    spread = (halves[0].var(correction=0) + WIDTH**2).sqrt()
    tau = -torch.log(torch.tensor(1 - OPACITY)) * WIDTH * MEMBERS / 2 / spread
    opacity = 1 - torch.exp(-tau)
    growth = 1 + opacity**2 * (torch.tensor(MEMBERS / 2).log10() / 2) * 0.5
    for name, scale, style in (("moments", 1.0, "--"), ("inflated", growth, "-")):
        painted = 1 - (1 - bells(x, middles, spread * scale, opacity)).prod(dim=0)
        axes.plot(x, painted, style, label=f"two merged Gaussians, {name}")
    axes.fill_between(x, together, color="0.85", label=f"{MEMBERS} members")
    axes.set(xlabel="position", ylabel="opacity", ylim=(0, 1.45), yticks=[0, 0.5, 1])
    axes.legend(loc="upper center", fontsize=8, frameon=False)


def bells(
    x: torch.Tensor,
    centers: torch.Tensor,
    width: float | torch.Tensor,
    opacity: float | torch.Tensor,
) -> torch.Tensor:
    """Return what each of some equal Gaussians paints."""
    return opacity * torch.exp(-0.5 * ((x - centers[:, None]) / width) ** 2)


def render_object(*, inflated: bool) -> torch.Tensor:
    """Render an object by merged Gaussians without a network."""
    scene = cvtgs.synthetic.scene("object", 60_000, sh_degree=0, seed=4)
    merge = {} if inflated else {"inflation": 0.0, "covered_inflation": 0.0}
    config = SimplifyConfig.from_mapping({"preset": "fast", "merge": merge | {"network": False}})
    small = cvtgs.Simplifier(None, config=config).simplify(scene, count=600)
    eye = torch.tensor([[2.2, -1.6, -2.2]])
    center = torch.tensor([[0.0, -0.5, 0.0]])
    cameras = Cameras(
        viewmats=look_at(eye, center, torch.tensor([0.0, -1.0, 0.0])),
        Ks=torch.tensor([[[1.2 * SIZE, 0, SIZE / 2], [0, 1.2 * SIZE, SIZE / 2], [0, 0, 1]]]),
        width=SIZE,
        height=SIZE,
    )
    with torch.no_grad():
        return cvtgs.render(small, cameras, background=torch.ones(3)).rgb[0].clamp(0, 1)


if __name__ == "__main__":
    main()
