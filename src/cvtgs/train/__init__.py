"""Training of MergeNet: scenes, cases, losses, and a resumable loop."""

from cvtgs.train.config import DataConfig, LossConfig, TrainConfig, ViewsConfig
from cvtgs.train.loop import train
from cvtgs.train.scenes import Source
from cvtgs.train.state import Gain, History, TrainFiles, Validation

__all__ = [
    "DataConfig",
    "Gain",
    "History",
    "LossConfig",
    "Source",
    "TrainConfig",
    "TrainFiles",
    "Validation",
    "ViewsConfig",
    "train",
]
