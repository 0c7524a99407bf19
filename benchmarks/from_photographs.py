"""Train a scene from photographs, simplify it, and score it on held-out photographs.

``python -m benchmarks.from_photographs -o DIR`` renders a generated scene to make a dataset;
``python -m benchmarks.from_photographs FOLDER -o DIR`` reads one in the layout of NeRF-Synthetic
(``transforms_train.json``, ``transforms_test.json``). A fixed number of Gaussians, starting from
random points or from those of ``--points``, is fitted to the training images by gradient descent
without densification: a plain loop that a CPU can run, not a replacement for a trainer. The
result is simplified, and all scenes are scored on the test images, which no step has used.

DIR gets the dataset (if it was generated), the trained model in INRIA's layout, and
``from_photographs.md``. An existing model is not trained again.
"""

import argparse
import json
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from scipy.spatial import KDTree
from torch import Tensor

import cvtgs
from benchmarks.baselines import baseline
from benchmarks.measuring import write_file
from benchmarks.quality import PhotographJudge, Quality, any_lpips, cells_of, markdown_rows
from cvtgs.cameras import Cameras
from cvtgs.evaluation import fit_cameras, load_photographs
from cvtgs.evaluation.scorer import Metrics, chosen_metrics
from cvtgs.losses import image_loss
from cvtgs.validity import valid_part
from cvtgs.views import automatic_views

WHITE = (1.0, 1.0, 1.0)
RATES = {
    "means": 1.6e-3,
    "log_scales": 1e-2,
    "quats": 2e-3,
    "logit_opacities": 5e-2,
    "sh0": 1e-2,
    "shN": 5e-4,
}
"""Learning rates of Adam, which decay to a tenth; that of means is in scene radii."""

FIRST_OPACITY = 0.1
METHODS = ("paper", "paper, no network", "standard", "mass pruning")


def main(arguments: Sequence[str] | None = None) -> None:
    options = parser().parse_args(arguments)
    folder = options.dataset or options.output / "dataset"
    if options.dataset is None:
        if (folder / "transforms_test.json").is_file():
            print(f"{folder}: is used as it is, whatever --views and --seed are.", file=sys.stderr)
        else:
            take_pictures(folder, views=options.views, size=options.size, seed=options.seed)
    for split in ("train", "test"):
        if not (folder / f"transforms_{split}.json").is_file():
            raise SystemExit(f"{folder}: must hold transforms_{split}.json, found none.")
    train, test = (read_split(folder, split, options.size) for split in ("train", "test"))
    model = options.output / "point_cloud" / f"iteration_{options.steps}" / "point_cloud.ply"
    if model.is_file():
        said = "is not trained again, whatever --count, --size, --seed and --points are"
        print(f"{model}: {said}.", file=sys.stderr)
    else:
        points = None if options.points is None else valid_part(cvtgs.load(options.points)).means
        first = first_scene(train[0], options.count, points=points, seed=options.seed)
        model.parent.mkdir(parents=True, exist_ok=True)
        cvtgs.save(fit(first, *train, steps=options.steps, seed=options.seed), model)
    scene = cvtgs.load(model)
    cameras, photographs = test
    if options.lpips is not None:
        metrics = Metrics(lpips=any_lpips(options.lpips))
    else:
        metrics = chosen_metrics("auto", (cameras.width, cameras.height))
    judge = PhotographJudge(cameras, photographs, WHITE, metrics)
    rows = {f"trained, {len(scene):,} Gaussians": judge.score(scene)}
    for rho in options.rho:
        for name in METHODS:
            small = simplifier(name)(scene, cvtgs.target_count(len(scene), rho))
            rows[f"{name} at {rho:g}"] = judge.score(small)
    network = metrics.lpips.network if metrics.lpips else f"not measured, {metrics.note}"
    text = (
        f"{len(cameras)} held-out pictures of {cameras.width} x {cameras.height}; "
        f"{len(train[0])} for training, {options.steps} steps. LPIPS: {network}. "
        f"cvtgs {cvtgs.__version__}.\n\n{table(rows)}"
    )
    write_file(options.output / "from_photographs.md", text.encode())
    print(text)


def parser() -> argparse.ArgumentParser:
    found = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    found.add_argument("dataset", nargs="?", type=Path, metavar="FOLDER")
    found.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    found.add_argument("--points", type=Path, help="scene whose centres the training starts from")
    found.add_argument("--count", type=int, default=10_000, help="Gaussians to train")
    found.add_argument("--steps", type=int, default=2000)
    found.add_argument("--size", type=int, default=200, help="longer side of the images, pixels")
    found.add_argument("--views", type=int, default=64, help="images of the generated scene")
    found.add_argument("--rho", type=float, nargs="+", default=[0.1, 0.01])
    found.add_argument("--lpips", type=Path, help="weights file of LPIPS")
    found.add_argument("--seed", type=int, default=0)
    return found


def take_pictures(folder: Path, *, views: int, size: int, seed: int) -> None:
    """Write images of a generated scene in NeRF-Synthetic's layout; every eighth is for testing."""
    scene = cvtgs.synthetic.scene("object", 60_000, sh_degree=1, seed=seed)
    cameras = automatic_views(scene, views, width=size, height=size, seed=seed)
    for split in ("train", "test"):
        rows = [row for row in range(views) if (row % 8 == 0) == (split == "test")]
        frames = []
        for row in rows:
            camera = cameras.select(torch.tensor([row]))
            image = cvtgs.render(scene, camera)
            alpha = image.alpha[0][..., None]
            pixels = torch.cat([image.rgb[0] / alpha.clamp_min(1 / 255), alpha], dim=2)
            values = (pixels.clamp(0, 1) * 255).round().byte().numpy()
            path = folder / split / f"r_{row}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(values).save(path)
            pose = np.linalg.inv(camera.viewmats[0].double().numpy())
            pose[:, 1:3] *= -1  # to OpenGL axes
            frames.append(
                {"file_path": f"./{split}/{path.stem}", "transform_matrix": pose.tolist()}
            )
        angle = 2 * math.atan(size / 2 / float(cameras.Ks[0, 0, 0]))
        content = {"camera_angle_x": angle, "frames": frames}
        write_file(folder / f"transforms_{split}.json", json.dumps(content).encode())


def read_split(folder: Path, split: str, size: int) -> tuple[Cameras, Float[Tensor, "c h w 3"]]:
    """Read the cameras and the images of a split, over white."""
    cameras = fit_cameras(cvtgs.load_cameras(folder / f"transforms_{split}.json"), folder)
    if size < max(cameras.width, cameras.height):
        cameras = cameras.fitted(size)
    return cameras, load_photographs(folder, cameras, background=WHITE)


def first_scene(
    cameras: Cameras, count: int, *, points: Float[Tensor, "n 3"] | None, seed: int
) -> cvtgs.GaussianScene:
    """Return touching grey balls at given points, or at random points where cameras look."""
    g = torch.Generator().manual_seed(seed)
    if points is None:
        middle, radius = looked_at(cameras)
        points = middle + radius * (2 * torch.rand(count, 3, generator=g) - 1)
    else:
        points = points[torch.randperm(len(points), generator=g)[:count]].float()
    places = points.double().numpy()
    distances = KDTree(places).query(places, k=min(4, len(places)))[0][:, 1:]
    spacing = torch.from_numpy(np.sqrt((distances**2).mean(axis=1))).float().clamp_min(1e-6)
    logit = math.log(FIRST_OPACITY / (1 - FIRST_OPACITY))
    return cvtgs.GaussianScene(
        means=points,
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(len(points), 1),
        log_scales=torch.log(spacing)[:, None].repeat(1, 3),
        logit_opacities=torch.full((len(points),), logit),
        sh0=torch.zeros(len(points), 1, 3),
        shN=torch.zeros(len(points), 3, 3),
    )


def looked_at(cameras: Cameras) -> tuple[Float[Tensor, "3"], float]:
    """Return the point nearest to all view axes, and 0.8 of half the width of the view there."""
    axes, centers = cameras.viewmats[:, 2, :3].double(), cameras.centers.double()
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None]
    middle = torch.linalg.solve(across.sum(dim=0), (across @ centers[:, :, None]).sum(dim=0))[:, 0]
    distance = float((centers - middle).norm(dim=1).median())
    return middle.float(), 0.4 * distance * cameras.width / float(cameras.Ks[:, 0, 0].median())


def fit(
    scene: cvtgs.GaussianScene,
    cameras: Cameras,
    photographs: Float[Tensor, "c h w 3"],
    *,
    steps: int,
    seed: int,
    say: Callable[[str], None] = lambda text: print(text, file=sys.stderr),
) -> cvtgs.GaussianScene:
    """Fit a scene to images with Adam and ``0.8 L1 + 0.2 (1 - SSIM)``, one image per step."""
    tensors = {name: values.clone().requires_grad_() for name, values in scene.tensors().items()}
    _, radius = looked_at(cameras)
    optimizer = torch.optim.Adam(
        [
            {"params": [values], "lr": RATES[name] * (radius if name == "means" else 1.0)}
            for name, values in tensors.items()
        ],
        eps=1e-15,
    )
    falling = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.1 ** (1 / max(1, steps)))
    white, g, total = torch.tensor(WHITE), torch.Generator().manual_seed(seed), 0.0
    for step in range(1, steps + 1):
        row = torch.randint(len(cameras), (1,), generator=g)
        image = cvtgs.render(scene.with_tensors(tensors, {}), cameras.select(row), background=white)
        loss = image_loss(image.rgb, photographs[row], gradient_weight=0.0)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        falling.step()
        total += loss.item()
        if step % 200 == 0:
            say(f"step {step} of {steps}: loss {total / 200:.4f}")
            total = 0.0
    return scene.with_tensors({name: values.detach() for name, values in tensors.items()}, {})


def simplifier(name: str) -> Callable[[cvtgs.GaussianScene, int], cvtgs.GaussianScene]:
    """Return a simplification method by name."""
    if name == "mass pruning":
        return baseline(name)
    preset, separator, _ = name.partition(",")
    own = cvtgs.Simplifier(None if separator else "auto", config=preset)
    return lambda scene, count: own.run(scene, count=count).scene


def table(rows: dict[str, Quality]) -> str:
    """Return a table of scores on the photographs, and of losses against the trained scene."""
    full, *_ = rows.values()
    lines = [
        [name, *cells_of(found)[:3], f"{found.psnr - full.psnr:+.2f}"]
        for name, found in rows.items()
    ]
    return markdown_rows(["scene", "PSNR", "SSIM", "LPIPS", "against the trained one, dB"], lines)


if __name__ == "__main__":
    main()
