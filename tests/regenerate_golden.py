"""Golden outputs of the shipped checkpoints: ``python tests/regenerate_golden.py`` renews them.

Run it, check the table and commit it whenever a checkpoint in ``src/cvtgs/mergenet/data`` or its
effect is changed on purpose; ``mergenet/test_correct.py`` compares with the table.
"""

import json
from pathlib import Path

import torch

from cvtgs import GaussianScene, Simplifier, SimplifyConfig
from cvtgs.mergenet import SHIPPED, load_checkpoint
from cvtgs.synthetic import scene as make

TABLE = Path(__file__).with_name("golden_mergenet.json")
CASES = [
    f"{name} {kind} {rho}"
    for name in SHIPPED
    for kind, rho in (("object", 0.1), ("room", 0.02), ("landscape", 0.05), ("haze", 0.005))
]


def digests() -> dict[str, str]:
    """Return the digests of the shipped checkpoints."""
    return {name: load_checkpoint(name).digest for name in SHIPPED}


def figures(case: str) -> dict[str, float]:
    """Return figures of a generated scene after a checkpoint, and its changes to merged moments."""
    name, kind, rho = case.split()
    scene, config = make(kind, 4000, sh_degree=1, seed=11), SimplifyConfig.from_preset(name)
    small, report = Simplifier(name, config=config, device="cpu").run(scene, float(rho))
    plain = Simplifier(None, config=config, device="cpu").simplify(scene, float(rho))
    shifts = torch.linalg.vector_norm(small.means - plain.means, dim=1)
    cosines = (small.quats.double() * plain.quats.double()).sum(dim=1).abs()
    return {
        "mass": report.mass_out / report.mass_in,
        "log scale": float(small.log_scales.mean()),
        "opacity": float(small.opacities.mean()),
        "colour": float(small.sh0.mean()),
        "contrast": float(small.sh0.std()),
        "gloss": float(small.shN.square().mean().sqrt()),
        "shift": float((shifts / plain.scales.amax(dim=1)).mean()),
        "growth": change(small, plain, "log_scales"),
        "turn": float((1 - cosines).clamp_min(0).mean()),
        "fading": change(small, plain, "logit_opacities"),
        "recolouring": change(small, plain, "sh0"),
    }


def change(small: GaussianScene, plain: GaussianScene, name: str) -> float:
    """Mean absolute difference of one tensor."""
    return float((getattr(small, name) - getattr(plain, name)).abs().mean())


def main() -> None:
    """Write the table."""
    table = {"digests": digests(), "figures": {case: figures(case) for case in CASES}}
    TABLE.write_text(json.dumps(table, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
