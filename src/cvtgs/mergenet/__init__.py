"""MergeNet: learned corrections of merged Gaussians; sees descriptors only."""

from cvtgs.mergenet.compose import compose
from cvtgs.mergenet.correct import correct_cells
from cvtgs.mergenet.model import Architecture, MergeNet, Residuals
from cvtgs.mergenet.weights import (
    SHIPPED,
    Checkpoint,
    CheckpointInfo,
    load_checkpoint,
    save_checkpoint,
)

__all__ = [
    "SHIPPED",
    "Architecture",
    "Checkpoint",
    "CheckpointInfo",
    "MergeNet",
    "Residuals",
    "compose",
    "correct_cells",
    "load_checkpoint",
    "save_checkpoint",
]
