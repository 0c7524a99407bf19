"""Draw the README image: two generated scenes in full and with 10 % and 1 % of their Gaussians.

``python -m benchmarks.before_after docs/images/before_after.jpg`` needs Pillow and a minute.
"""

import argparse
from pathlib import Path
from typing import NamedTuple

import torch
from PIL import Image, ImageDraw, ImageFont

import cvtgs
from cvtgs.rendering import render

COUNT = 1_000_000
RATIOS = (1.0, 0.1, 0.01)
WIDTH, HEIGHT, GAP, TEXT = 600, 400, 6, 17


class Shot(NamedTuple):
    """A generated scene, and the automatic view to show."""

    kind: str
    seed: int
    view: int


SHOTS = (Shot("courtyard", 1, 0), Shot("room", 1, 5))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", type=Path)
    parser.add_argument("--count", type=int, default=COUNT)
    options = parser.parse_args()
    options.output.parent.mkdir(parents=True, exist_ok=True)
    size = (
        len(RATIOS) * (WIDTH + GAP) - GAP,
        len(SHOTS) * (HEIGHT + GAP) - GAP,
    )
    sheet, simplifier = Image.new("RGB", size, "white"), cvtgs.Simplifier()
    for row, shot in enumerate(SHOTS):
        scene = cvtgs.synthetic.scene(shot.kind, options.count, sh_degree=1, seed=shot.seed)
        views = cvtgs.views.automatic_views(scene, 6, width=WIDTH, height=HEIGHT)
        camera = views.select(torch.tensor([shot.view]))
        for column, ratio in enumerate(RATIOS):
            small = simplifier.simplify(scene, ratio)
            tile = captioned(image_of(small, camera), f"{len(small):,} Gaussians")
            sheet.paste(tile, (column * (WIDTH + GAP), row * (HEIGHT + GAP)))
    sheet.save(options.output, quality=92)


def image_of(scene: cvtgs.GaussianScene, camera: cvtgs.Cameras) -> Image.Image:
    with torch.no_grad():
        colors = render(scene, camera).rgb[0]
    return Image.fromarray(colors.clamp(0, 1).mul(255).round().byte().numpy())


def captioned(image: Image.Image, text: str) -> Image.Image:
    """Draw a text in the lower left corner."""
    draw, font = ImageDraw.Draw(image, "RGBA"), ImageFont.load_default(TEXT)
    box = (0, HEIGHT - TEXT - 14, font.getlength(text) + 20, HEIGHT)
    draw.rectangle(box, fill=(0, 0, 0, 150))
    draw.text((10, HEIGHT - TEXT - 9), text, "white", font)
    return image


if __name__ == "__main__":
    main()
