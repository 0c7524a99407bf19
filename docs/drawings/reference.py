"""Without and with MergeNet: ``python -m docs.drawings.reference docs/images/reference.png``.

A generated courtyard of 100,000 Gaussians simplified to 5,000: by the moments of CVT-GS, by those
of the preset ``standard``, and with its network; below, the differences to the full scene.
"""

import argparse
from pathlib import Path

import torch

import cvtgs
from cvtgs.cameras import Cameras, look_at
from cvtgs.evaluation import psnr
from docs.drawings.saving import figure, save_small

COUNT, RHO, CROP = 100_000, 0.05, (slice(70, 430), slice(40, 440))
SIZE = 480


def main() -> None:
    """Draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", type=Path)
    options = parser.parse_args()
    scene = cvtgs.synthetic.demo_scene(COUNT, seed=0)
    scenes = {
        "full": scene,
        "moments as in CVT-GS": cvtgs.Simplifier(None, config="paper").simplify(scene, RHO),
        "moments of standard": cvtgs.Simplifier(None).simplify(scene, RHO),
        "with MergeNet": cvtgs.Simplifier().simplify(scene, RHO),
    }
    with torch.no_grad():
        images = {
            name: cvtgs.render(one, camera()).rgb[0][CROP].clamp(0, 1)
            for name, one in scenes.items()
        }
    canvas, panels = figure(2, 4, width=9.0, height=4.6)
    full = images["full"]
    for axes, (name, image) in zip(panels[0], images.items(), strict=True):
        axes.imshow(image)
        axes.set_title(f"{name}\n{len(scenes[name]):,} Gaussians", fontsize=10)
    panels[1, 0].set_axis_off()
    for axes, image in list(zip(panels[1], images.values(), strict=True))[1:]:
        shown = axes.imshow((image - full).abs().mean(dim=2), vmin=0, vmax=0.3, cmap="gray")
        axes.set_xlabel(f"{psnr(image[None], full[None]).item():.2f} dB")
    below = panels[1, 0].inset_axes((0.1, 0.6, 0.8, 0.07))
    bar = canvas.colorbar(shown, cax=below, orientation="horizontal")
    bar.set_label("mean absolute difference")
    for axes in panels.flat:
        axes.set(xticks=[], yticks=[])
    save_small(canvas, options.output)


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
