"""Simplify a checkpoint of gsplat's trainer for further use with the trainer.

python examples/gsplat_checkpoint.py results/garden/ckpts/ckpt_29999_rank0.pt small.pt --rho 0.1

The output is a dictionary with "splats" again, which ``simple_trainer.py --ckpt small.pt`` renders.
"""

import argparse
from pathlib import Path

import torch

import cvtgs


def main() -> None:
    """Read, simplify, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--rho", type=float, default=0.1)
    options = parser.parse_args()
    scene = cvtgs.load(options.checkpoint)
    small = cvtgs.Simplifier().simplify(scene, options.rho)
    # In memory, use cvtgs.from_dict(model.splats) and cvtgs.to_dict(small) instead of files.
    torch.save({"step": 0, "splats": cvtgs.to_dict(small)}, options.output)


if __name__ == "__main__":
    main()
