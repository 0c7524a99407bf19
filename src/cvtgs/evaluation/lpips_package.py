"""The files of the optional ``lpips`` package; the only place that knows it."""

from importlib.util import find_spec
from pathlib import Path

import torch

from cvtgs.evaluation.lpips_network import LpipsNetwork

_BACKBONES: dict[LpipsNetwork, str] = {
    "alex": "alexnet-owt-7be5be79.pth",
    "vgg": "vgg16-397923af.pth",
}


def package_files(network: LpipsNetwork) -> tuple[Path, Path] | None:
    """Report where the installed package has its weights, without importing it.

    Importing it would load torchvision, and making its model would download the backbone.
    """
    spec = find_spec("lpips")
    if spec is None or spec.origin is None:
        return None
    backbone = Path(torch.hub.get_dir()) / "checkpoints" / _BACKBONES[network]
    return backbone, Path(spec.origin).parent / "weights" / "v0.1" / f"{network}.pth"
