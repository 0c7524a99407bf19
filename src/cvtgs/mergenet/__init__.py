"""MergeNet: learned corrections of merged Gaussians, predicted from descriptors alone."""

from cvtgs.mergenet.apply import compose, correct_cells
from cvtgs.mergenet.checkpoint import (
    SHIPPED,
    Checkpoint,
    CheckpointInfo,
    LearnedScene,
    encode_checkpoint,
    load_checkpoint,
)
from cvtgs.mergenet.model import (
    Architecture,
    CellNetwork,
    KnownRange,
    MergeNet,
    Residuals,
    summarize,
)
from cvtgs.mergenet.published import (
    Net,
    PublishedArchitecture,
    PublishedDescriptors,
    PublishedMergeNet,
    PublishedResiduals,
)

__all__ = [
    "SHIPPED",
    "Architecture",
    "CellNetwork",
    "Checkpoint",
    "CheckpointInfo",
    "KnownRange",
    "LearnedScene",
    "MergeNet",
    "Net",
    "PublishedArchitecture",
    "PublishedDescriptors",
    "PublishedMergeNet",
    "PublishedResiduals",
    "Residuals",
    "compose",
    "correct_cells",
    "encode_checkpoint",
    "load_checkpoint",
    "summarize",
]
