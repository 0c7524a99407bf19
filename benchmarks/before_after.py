"""The image of the README: a generated scene in full, and with 10 % and 1 % of its Gaussians.

``python -m benchmarks.before_after docs/images/before_after.png`` needs Pillow.
"""

import argparse
from pathlib import Path

import torch
from PIL import Image

import cvtgs
from cvtgs.cameras import Cameras, look_at
from cvtgs.rendering import render

RATIOS = (1.0, 0.1, 0.01)
SIZE = 480


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", type=Path)
    options = parser.parse_args()
    scene = cvtgs.synthetic.demo_scene(seed=0)
    simplifier = cvtgs.Simplifier()
    with torch.no_grad():
        images = [render(simplifier.simplify(scene, rho), camera()).rgb[0] for rho in RATIOS]
    pixels = torch.cat(images, dim=1).clamp(0, 1).mul(255).round().byte()
    Image.fromarray(pixels.numpy()).save(options.output)


def camera() -> Cameras:
    """Stand at the edge of the courtyard (y points down) and look at its middle."""
    eye, target = torch.tensor([[2.9, -2.3, -4.0]]), torch.tensor([[-0.2, -0.8, 0.0]])
    focal = 0.95 * SIZE
    intrinsics = torch.tensor([[[focal, 0, SIZE / 2], [0, focal, SIZE / 2], [0, 0, 1]]])
    return Cameras(
        viewmats=look_at(eye, target, torch.tensor([0.0, -1.0, 0.0])),
        Ks=intrinsics,
        width=SIZE,
        height=SIZE,
    )


if __name__ == "__main__":
    main()
