"""MergeNet: learned corrections of merged Gaussians, predicted from descriptors alone."""

from cvtgs.mergenet.apply import compose, correct_cells
from cvtgs.mergenet.checkpoint import (
    SHIPPED,
    Checkpoint,
    CheckpointInfo,
    LearnedScene,
    load_checkpoint,
    save_checkpoint,
)
from cvtgs.mergenet.known import KnownRange, summarize
from cvtgs.mergenet.model import Architecture, MergeNet, Residuals

__all__ = [
    "SHIPPED",
    "Architecture",
    "Checkpoint",
    "CheckpointInfo",
    "KnownRange",
    "LearnedScene",
    "MergeNet",
    "Residuals",
    "compose",
    "correct_cells",
    "load_checkpoint",
    "save_checkpoint",
    "summarize",
]
