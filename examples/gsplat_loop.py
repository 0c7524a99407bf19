"""Simplify in the middle of a training loop written for gsplat, and continue training.

python examples/gsplat_loop.py --steps 50

With CUDA and gsplat, gsplat.rasterization renders the images; otherwise cvtgs.rendering does.
"""

import argparse
from collections.abc import Mapping

import torch

import cvtgs


def main() -> None:
    """Render targets, simplify the model, and continue training it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=20_000)
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--size", type=int, default=128, help="side of the images, pixels")
    options = parser.parse_args()
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    trained = cvtgs.synthetic.scene("object", options.count, sh_degree=1, seed=0).to(device)
    views = cvtgs.views.automatic_views(trained, 4, width=options.size, height=options.size)
    targets = image(cvtgs.to_dict(trained), views)  # in your own loop: photographs

    scene = cvtgs.from_dict(cvtgs.to_dict(trained))  # for a model: cvtgs.from_dict(model.splats)
    small = cvtgs.to_dict(cvtgs.Simplifier().simplify(scene, 0.1))
    splats = {name: torch.nn.Parameter(values) for name, values in small.items()}
    rates = {"scales": 5e-3, "opacities": 5e-2, "sh0": 2e-3}
    groups = [{"params": [values], "lr": rates.get(name, 1e-4)} for name, values in splats.items()]
    optimizer = torch.optim.Adam(groups, eps=1e-15)
    for step in range(options.steps):
        view = step % len(views)
        shown = image(splats, views.select(torch.tensor([view])))[0]
        loss = (shown - targets[view]).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % 10 == 0 or step == options.steps - 1:
            print(f"step {step}: loss {loss.item():.5f}")


def image(splats: Mapping[str, torch.Tensor], views: cvtgs.Cameras) -> torch.Tensor:
    """Render the parameters of a model differentiably, by gsplat where it works."""
    scene = cvtgs.GaussianScene(
        means=splats["means"],
        quats=splats["quats"],
        log_scales=splats["scales"],
        logit_opacities=splats["opacities"],
        sh0=splats["sh0"],
        shN=splats["shN"],
    )
    return cvtgs.render(scene, views, backend="auto").rgb


if __name__ == "__main__":
    main()
