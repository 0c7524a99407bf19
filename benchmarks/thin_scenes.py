"""Compare cells with and without representatives with mass pruning, on points and needles.

``python -m benchmarks.thin_scenes`` prints PSNR and SSIM of images from automatic views, without
the compensation of Mip-Splatting, for scenes of ``tests/hard_cases.py``.
"""

import argparse

import torch

import cvtgs
from benchmarks.baselines.pruning import keep_most_mass
from benchmarks.numerics import catalogue
from benchmarks.quality import score_views
from cvtgs import Simplifier, SimplifyConfig
from cvtgs.views import automatic_views

MOMENTS = {"merge.representatives": "false"}
VARIANTS = {"standard": {}, "moments only": MOMENTS, "paper": {"preset": "paper"}}
VARIANTS["paper, with representatives"] = {"preset": "paper", "merge.representatives": "true"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--case", nargs="+", choices=catalogue(), default=["points", "needles"])
    parser.add_argument("--count", type=int, default=4000)
    parser.add_argument("--rho", type=float, nargs="+", default=[0.2, 0.02])
    parser.add_argument("--size", type=int, default=400, help="side of the images")
    parser.add_argument("--views", type=int, default=8)
    options = parser.parse_args()
    print("| case | rho | " + " | ".join([*VARIANTS, "mass pruning"]) + " |")
    print("|---" * (len(VARIANTS) + 3) + "|")
    for name in options.case:
        scene = catalogue()[name](options.count, torch.float32)
        size = options.size
        cameras = automatic_views(scene, options.views, width=size, height=size)
        for rho in options.rho:
            count = cvtgs.target_count(len(scene), rho)
            small = {text: simplified(scene, count, how) for text, how in VARIANTS.items()}
            small["mass pruning"] = keep_most_mass(scene, count)
            scores = score_views(scene, small, cameras).values()
            cells = (f"{score.psnr:.2f} dB / {score.ssim:.3f}" for score in scores)
            print(f"| {name} | {rho:g} | " + " | ".join(cells) + " |")


def simplified(
    scene: cvtgs.GaussianScene, count: int, settings: dict[str, str]
) -> cvtgs.GaussianScene:
    config = SimplifyConfig.compose(settings=settings)
    return Simplifier(config=config, device="cpu").simplify(scene, count=count)


if __name__ == "__main__":
    main()
