"""Training of MergeNet: scenes, cases, losses, and a loop that can be interrupted."""

from cvtgs.train.config import DataConfig, LossConfig, TrainConfig, ViewsConfig
from cvtgs.train.history import History, Validation
from cvtgs.train.loop import TrainFiles, train
from cvtgs.train.scenes import Source, find_sources

__all__ = [
    "DataConfig",
    "History",
    "LossConfig",
    "Source",
    "TrainConfig",
    "TrainFiles",
    "Validation",
    "ViewsConfig",
    "find_sources",
    "train",
]
