"""Score presets on a scene without photographs, and write a page that shows them side by side.

python examples/compare.py scene.ply page --rho 0.01 --presets draft,standard,high
"""

import argparse
from pathlib import Path

import cvtgs
from cvtgs.evaluation import EvaluationSettings, compare, write_comparison


def main() -> None:
    """Simplify with every preset, score, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("input", type=Path)
    parser.add_argument("output", type=Path, help="folder for index.html")
    parser.add_argument("--rho", type=float, default=0.01)
    parser.add_argument("--presets", default="draft,standard", help="separated by commas")
    parser.add_argument("--size", type=int, default=480, help="side of the images, pixels")
    options = parser.parse_args()
    scene = cvtgs.load(options.input)
    small = {
        preset: cvtgs.Simplifier(config=preset).simplify(scene, options.rho)
        for preset in map(str.strip, options.presets.split(","))
    }
    views = cvtgs.views.automatic_views(scene, 4, width=options.size, height=options.size)
    # lpips="auto" also measures LPIPS if its weights are found.
    comparison = compare(scene, small, views, settings=EvaluationSettings(lpips="off"))
    for scores in comparison.evaluation.scenes:
        print(f"{scores.name:<10} {scores.psnr.mean:6.2f} dB, SSIM {scores.ssim.mean:.3f}")
    write_comparison(comparison, options.output)


if __name__ == "__main__":
    main()
