"""Train a MergeNet on generated scenes and use it: a complete run in seconds, as a starting point.

python examples/train_tiny.py tiny.safetensors --steps 20

Such a short training learns nothing useful; recipes/standard.toml makes a network as good as the
shipped one.
"""

import argparse
from pathlib import Path

from cvtgs.startup import load_torch

load_torch()  # its idle threads then sleep soon, which saves minutes on a busy machine

import cvtgs  # noqa: E402
from cvtgs.train import (  # noqa: E402
    DataConfig,
    History,
    TrainConfig,
    TrainFiles,
    ViewsConfig,
    train,
)


def main() -> None:
    """Train, then simplify with the trained network."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--count", type=int, default=5_000, help="Gaussians of each scene")
    options = parser.parse_args()
    config = TrainConfig(
        steps=options.steps,
        validate_every=max(1, options.steps // 2),
        width=16,
        cell_width=32,
        data=DataConfig(
            generated=1, generated_counts=(options.count,), blocks=0,
            ratios=(0.1,), validation_ratios=(0.1,),
        ),
        views=ViewsConfig(count=2, sizes=(64,), crop=64, validation_count=1, validation_size=64),
    )  # fmt: skip
    train(config, TrainFiles.beside(options.checkpoint), on_validation=show)
    scene = cvtgs.synthetic.scene("object", options.count, seed=99)
    small = cvtgs.Simplifier(options.checkpoint).simplify(scene, 0.1)
    print(f"{len(scene):,} -> {len(small):,} Gaussians with {options.checkpoint}")


def show(history: History) -> None:
    """Print the mean gain over scenes that are not trained on."""
    last = history.validations[-1]
    print(f"step {last.step}: {last.mean_gain:+.3f} dB")


if __name__ == "__main__":
    main()
