"""Measure the gain of presets and settings over ``standard``, by the height of the viewpoint.

``python -m benchmarks.heights FILES --rho 0.1 high "standard refine.steps=100"`` scores each
variant (a preset, followed by settings) from twelve random directions at each of nine heights,
including from below and from inside the ground, with cvtgs' own renderer, and prints Markdown.
A small set of views misleads if some are inside solid ground, where PSNR changes by tens of dB.
"""

import argparse
from pathlib import Path

import torch
from torch import Tensor

import cvtgs
from benchmarks.cameras import cameras_around
from benchmarks.measuring import settings_of
from benchmarks.quality import scenes
from cvtgs.cameras import Cameras
from cvtgs.evaluation import psnr

HEIGHTS = ((90, 1.5), (60, 1.2), (35, 1.6), (20, 1.2), (20, 2.8), (10, 2.2), (-15, 2.8), (-35, 2.0),
           (-60, 1.5))  # fmt: skip
"""Elevation in degrees above the level of the centre, and distance in robust radii."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("variants", nargs="+", help="files, then presets with settings")
    parser.add_argument("--rho", type=float, default=0.1)
    parser.add_argument("--views", type=int, default=12, help="views at each height")
    parser.add_argument("--size", type=int, default=256, help="side of the images, pixels")
    parser.add_argument("--count", type=int, default=60_000, help="size of generated scenes")
    options = parser.parse_intermixed_args()
    variants = [word for word in options.variants if word.partition(" ")[0] in cvtgs.PRESETS]
    files = [Path(word) for word in options.variants if word not in variants]
    print(f"| scene, rho {options.rho:g} | variant | all views |", end="")
    print(*(f" {height}°, {far:g} R |" for height, far in HEIGHTS), sep="")
    print("|---|---|---|" + "---|" * len(HEIGHTS))
    for name, scene in scenes(files, options.count):
        cameras = [
            views_at(scene, *place, options.views, size=options.size, seed=k)
            for k, place in enumerate(HEIGHTS)
        ]
        base = scores(scene, "standard", cameras, options.rho)
        print(f"| {name} | standard |", *(f"{value:.2f} |" for value in [base.mean(), *base]))
        for variant in variants:
            found = scores(scene, variant, cameras, options.rho)
            gain = torch.where(found == base, 0.0, found - base)  # which may be infinite
            words = (f"{value:+.2f} |" for value in [gain.mean(), *gain])
            print(f"| {name} | {variant} |", *words, flush=True)


def views_at(
    scene: cvtgs.GaussianScene, height: float, far: float, count: int, *, size: int, seed: int
) -> Cameras:
    """Return cameras in random directions from one elevation and distance."""
    azimuths = 360 * torch.rand(count, generator=torch.Generator().manual_seed(seed))
    return cameras_around(scene, azimuths, elevation=height, distance=far, size=size)


def scores(scene: cvtgs.GaussianScene, variant: str, cameras: list[Cameras], rho: float) -> Tensor:
    """Return the mean PSNR at each height."""
    preset, *words = variant.split()
    config = cvtgs.SimplifyConfig.compose(preset=preset, settings=settings_of(words))
    small = cvtgs.Simplifier(config=config).simplify(scene, rho)
    pairs = ([cvtgs.render(one, views).rgb for one in (small, scene)] for views in cameras)
    return torch.stack([psnr(*(one.clamp(0, 1) for one in pair)).mean() for pair in pairs])


if __name__ == "__main__":
    main()
