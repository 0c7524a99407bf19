"""Generate yards that resemble trained unbounded captures, to train and evaluate networks.

``python -m benchmarks.yards FOLDER`` writes the yards of ``recipes/standard.toml`` (``yard11`` to
``yard20``; the shipped ``standard`` was trained on those up to ``yard16``) and three for evaluation
(``yard1`` to ``yard3``), each with its cameras. Gaussians are dense in the middle and grow with the
distance. About 4 % of them form a shell of huge, faint Gaussians 40 to 250 units away, and some are
floaters.
"""

import argparse
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

import cvtgs
from benchmarks.cameras import beside_format, looking
from cvtgs import synthetic
from cvtgs.cameras import Cameras
from cvtgs.math.spherical_harmonics import SH_C0
from cvtgs.scene import GaussianScene

Array = NDArray[np.float64]

YARDS = {
    "yard1": (300_000, 1, 3),
    "yard2": (200_000, 2, 1),
    "yard3": (150_000, 3, 0),
    "yard11": (100_000, 11, 1),
    "yard12": (80_000, 12, 0),
    "yard13": (60_000, 13, 2),
    "yard14": (100_000, 14, 1),
    "yard15": (200_000, 15, 0),
    "yard16": (250_000, 16, 1),
    "yard17": (150_000, 17, 0),
    "yard18": (100_000, 18, 1),
    "yard19": (200_000, 19, 0),
    "yard20": (80_000, 20, 2),
}
"""Number of Gaussians, seed and SH degree of every yard."""

SHARES = {
    "ground": 0.42,
    "sky": 0.04,
    "trees": 0.17,
    "floaters": 0.012,
    "grass": 0.12,
    "walls": 0.12,
}
"""Shares of the Gaussians; the rest form the object in the middle."""

WAVES = ((0.2, 0.25), (0.7, 0.25), (2.5, 0.3), (9.0, 0.4))
"""Wavelengths and amplitudes of the waves of a texture."""

VIEWS, WIDTH, HEIGHT = 10, 400, 300


class Part(NamedTuple):
    """Gaussians with activated parameters."""

    means: Array
    scales: Array
    quats: Array
    opacities: Array
    colors: Array


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="folder to write to")
    folder: Path = parser.parse_args(arguments).folder
    folder.mkdir(parents=True, exist_ok=True)
    for name, (count, seed, degree) in YARDS.items():
        cvtgs.save(yard(count, seed=seed, degree=degree), folder / f"{name}.ply")
        (folder / f"{name}.cameras.json").write_text(json.dumps(beside_format(cameras())))
        print(folder / f"{name}.ply")


def yard(count: int, *, seed: int, degree: int) -> GaussianScene:
    """Make a yard with an object on grass, walls, trees, a sky and floaters; y-down."""
    rng, fine = np.random.default_rng(seed), math.sqrt(300_000 / count)
    counts = {name: int(share * count) for name, share in SHARES.items()}
    parts = [
        _ground(counts["ground"], fine, rng),
        _grass(counts["grass"], fine, rng),
        _walls(counts["walls"], fine, rng),
        _trees(counts["trees"], rng),
        _sky(counts["sky"], rng),
        _floaters(counts["floaters"], rng),
    ]
    made = Part(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    center = synthetic.scene("object", count - sum(counts.values()), sh_degree=degree, seed=seed)
    size = 0.6 / float(center.means.abs().quantile(0.95))
    own = stored(made) | {"shN": rng.normal(0, 0.03, (len(made.means), center.shN.shape[1], 3))}
    others = center.tensors() | {
        "means": center.means * size + torch.tensor([0.0, -0.02, 0.0]),
        "log_scales": center.log_scales + math.log(size),
    }
    joined: dict[str, Any] = {
        name: torch.cat([torch.tensor(values, dtype=torch.float32), others[name]])
        for name, values in own.items()
    }
    return GaussianScene(**joined)


def far_surroundings(count: int, *, from_radius: float, seed: int) -> GaussianScene:
    """Make trees, sky, floaters, and the ground of a yard beyond a radius, of SH degree 0."""
    rng, fine = np.random.default_rng(seed), math.sqrt(300_000 / count)
    shares = {name: SHARES[name] for name in ("trees", "sky", "floaters")}
    trees, sky, floaters = (int(share * count) for share in shares.values())
    ground = _ground(2 * (count - trees - sky - floaters), fine, rng)
    is_far = np.hypot(ground.means[:, 0], ground.means[:, 2]) > from_radius
    parts = [
        Part(*(column[is_far] for column in ground)),
        _trees(trees, rng),
        _sky(sky, rng),
        _floaters(floaters, rng),
    ]
    return joined_parts(parts)


def joined_parts(parts: Sequence[Part]) -> GaussianScene:
    """Return the Gaussians of several parts as a scene of SH degree 0."""
    own = stored(Part(*(np.concatenate(columns) for columns in zip(*parts, strict=True))))
    own["shN"] = np.zeros((len(own["means"]), 0, 3))
    tensors: dict[str, Any] = {
        name: torch.tensor(values, dtype=torch.float32) for name, values in own.items()
    }
    return GaussianScene(**tensors)


def stored(part: Part) -> dict[str, Array]:
    """Return the stored parameters of Gaussians, but for view-dependent colour."""
    opacities = np.clip(part.opacities, 0.004, 0.995)
    return {
        "means": part.means,
        "quats": part.quats,
        "log_scales": np.log(part.scales),
        "logit_opacities": np.log(opacities / (1 - opacities)),
        "sh0": ((np.clip(part.colors, 0, 1) - 0.5) / SH_C0)[:, None],
    }


def cameras() -> Cameras:
    """Return cameras of a walk around the object."""
    turns, steps = torch.arange(VIEWS) * 2 * math.pi / VIEWS, torch.arange(VIEWS) % 3
    heights, away = torch.tensor([0.5, 0.8, 1.3])[steps], torch.tensor([1.6, 2.2, 2.8])[steps]
    eyes = torch.stack([away * torch.cos(turns), -heights, away * torch.sin(turns)], dim=1).double()
    targets = torch.zeros(VIEWS, 3).double()
    targets[:, 1] = -0.3
    targets[::3] = -eyes[::3]
    targets[::3, 1] = -0.6
    up = torch.tensor([0.0, -1.0, 0.0]).double()
    return looking(eyes, targets, up, size=(WIDTH, HEIGHT), field=60)


def _ground(count: int, fine: float, rng: np.random.Generator) -> Part:
    radius = np.exp(rng.uniform(np.log(0.25), np.log(40), count))
    radius[: count // 3] = 1.5 * np.sqrt(rng.uniform(0, 1, count // 3))
    turn = rng.uniform(0, 2 * np.pi, count)
    x, z = radius * np.cos(turn), radius * np.sin(turn)
    means = np.stack([x, 0.03 * _texture(np.stack([x, 0 * x, z], 1), rng), z], 1)
    size = np.maximum(radius, 0.7) * 0.012 * np.exp(rng.normal(0, 0.5, count)) * fine
    colors = np.array([0.28, 0.33, 0.14]) + 0.22 * _texture(means, rng)[:, None]
    colors = colors + rng.normal(0, 0.08, (count, 1)) + rng.normal(0, 0.02, (count, 3))
    normals = unit(np.array([0, -1, 0.0]) + rng.normal(0, 0.25, (count, 3)))
    scales = np.stack([size, size * np.exp(rng.normal(0, 0.3, count)), size * 0.15], 1)
    return Part(means, scales, turned_to(normals), rng.beta(1.2, 0.8, count), colors)


def _grass(count: int, fine: float, rng: np.random.Generator) -> Part:
    radius, turn = 2.5 * np.sqrt(rng.uniform(0.02, 1, count)), rng.uniform(0, 2 * np.pi, count)
    height = -rng.uniform(0, 0.08, count)
    means = np.stack([radius * np.cos(turn), height, radius * np.sin(turn)], 1)
    length = 0.02 * np.exp(rng.normal(0, 0.4, count)) * fine**0.7
    blades = unit(np.array([0, -1, 0.0]) + rng.normal(0, 0.4, (count, 3)))
    scales, opacities = np.stack([length * 0.2, length * 0.2, length], 1), rng.beta(1, 0.9, count)
    colors = np.array([0.35, 0.42, 0.15]) + 0.2 * _texture(means, rng)[:, None]
    colors = colors + rng.normal(0, 0.12, (count, 1))
    return Part(means, scales, turned_to(blades), opacities, colors)


def _walls(count: int, fine: float, rng: np.random.Generator) -> Part:
    kind = rng.integers(0, 3, count)[:, None]
    u, v = rng.uniform(-1, 1, count), rng.uniform(0, 1, count)
    house = np.stack([4 + 0 * u, -2.5 * v, 4 * u], 1)
    low, fence = (
        np.stack([-5 * u, -1.2 * v, 5 + 0 * u], 1),
        np.stack([-6 + 0 * u, -1.5 * v, 6 * u], 1),
    )
    means = np.where(kind == 0, house, np.where(kind == 1, low, fence))
    normals = np.where(kind == 1, [0, 0, 1], [1, 0, 0]).astype(float)
    normals = unit(normals + rng.normal(0, 0.1, (count, 3)))
    size = 0.03 * np.exp(rng.normal(0, 0.6, count)) * fine
    joints = (np.sin(means[:, 1] * 40) > 0.8) * -0.2
    placed = means + rng.normal(0, 0.02, means.shape)
    opacities = rng.beta(1.3, 0.8, count)
    colors = np.array([0.6, 0.5, 0.42]) + 0.15 * _texture(means, rng)[:, None] + joints[:, None]
    colors = colors + rng.normal(0, 0.05, (count, 1))
    scales = np.stack([size, size, size * 0.1], 1)
    return Part(placed, scales, turned_to(normals), opacities, colors)


def _trees(count: int, rng: np.random.Generator) -> Part:
    away, turn = rng.uniform(6, 18, 14), rng.uniform(0, 6.28, 14)
    height = -rng.uniform(2, 4, 14)
    x = away * np.cos(turn)
    crowns = np.stack([x, height, np.abs(x) * np.tan(rng.uniform(-1, 1, 14))], 1)
    crown = rng.integers(0, 14, count)
    means = crowns[crown] + rng.normal(0, 1, (count, 3)) * [1.6, 1.4, 1.6]
    size = np.linalg.norm(means, axis=1) * 0.006 * np.exp(rng.normal(0, 0.6, count))
    quats = unit(rng.normal(size=(count, 4)))
    scales = size[:, None] * np.exp(rng.normal(0, 0.5, (count, 3)))
    opacities = rng.beta(0.8, 1.2, count)
    colors = np.array([0.16, 0.26, 0.1]) + 0.12 * _texture(means, rng)[:, None]
    return Part(means, scales, quats, opacities, colors + rng.normal(0, 0.09, (count, 1)))


def _sky(count: int, rng: np.random.Generator) -> Part:
    ways = rng.normal(size=(count, 3))
    ways[:, 1] = -np.abs(ways[:, 1]) * 0.9 + 0.05
    ways = unit(ways)
    away = np.exp(rng.uniform(np.log(40), np.log(250), count))
    size = away * 0.05 * np.exp(rng.normal(0, 0.7, count))
    up = np.clip(-ways[:, 1], 0, 1)[:, None]
    scales = size[:, None] * np.exp(rng.normal(0, 0.6, (count, 3)))
    quats, opacities = unit(rng.normal(size=(count, 4))), rng.beta(0.6, 1.6, count)
    colors = (1 - up) * [0.85, 0.88, 0.92] + up * [0.45, 0.62, 0.9]
    colors = colors + 0.06 * _texture(ways * 30, rng)[:, None]
    return Part(ways * away[:, None], scales, quats, opacities, colors)


def _floaters(count: int, rng: np.random.Generator) -> Part:
    ways = rng.normal(size=(count, 3))
    ways[:, 1] = -np.abs(ways[:, 1])
    away = np.exp(rng.uniform(np.log(1), np.log(30), count))[:, None]
    size = away * 0.015 * np.exp(rng.normal(0, 0.8, count))[:, None]
    scales = size * np.exp(rng.normal(0, 0.5, (count, 3)))
    quats = unit(rng.normal(size=(count, 4)))
    opacities = 0.1 * rng.beta(0.6, 1.2, count) + 0.004
    colors = rng.uniform(0.2, 0.8, (count, 1)) + rng.normal(0, 0.05, (count, 3))
    return Part(unit(ways) * away, scales, quats, opacities, colors)


def _texture(points: Array, rng: np.random.Generator) -> Array:
    """Evaluate a sum of waves in random directions at every point."""
    total = np.zeros(len(points))
    for length, height in WAVES:
        for _ in range(4):
            wave = rng.normal(size=3) / length
            total += height / 2 * np.sin(points @ wave + rng.uniform(0, 6.28))
    return total


def unit(vectors: Array) -> Array:
    lengths: Array = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / lengths


def turned_to(normals: Array) -> Array:
    """Return quaternions that rotate the third axis to the normals."""
    third = np.broadcast_to(np.array([0, 0, 1.0]), normals.shape)
    return unit(np.concatenate([1 + normals[:, 2:], np.cross(third, normals)], axis=1))


if __name__ == "__main__":
    main()
