"""Make trained 3D Gaussian Splatting scenes 10 to 1000 times smaller, in seconds.

>>> import cvtgs
>>> scene = cvtgs.synthetic.demo_scene(1000, seed=0)
>>> small = cvtgs.Simplifier().simplify(scene, rho=0.1)
>>> len(small)
100

Names are loaded when they are first used, so that ``import cvtgs`` costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cvtgs import (
        analysis,
        boxes,
        budget,
        cells,
        cvt,
        edit,
        errors,
        evaluation,
        filters,
        io,
        levels,
        losses,
        matching,
        math,
        mergenet,
        outofcore,
        pipeline,
        refinement,
        rendering,
        streams,
        synthetic,
        tradeoff,
        train,
        validity,
        views,
    )
    from cvtgs.analysis import EffectPlan
    from cvtgs.cameras import Cameras
    from cvtgs.config import PRESETS, SimplifyConfig
    from cvtgs.counts import target_count
    from cvtgs.edit import concatenate
    from cvtgs.errors import CvtgsError
    from cvtgs.evaluation import evaluate
    from cvtgs.info import SceneInfo, describe
    from cvtgs.io import from_dict, load, load_cameras, save, to_dict
    from cvtgs.prepared import Prepared
    from cvtgs.progress import ProgressEvent, ProgressListener
    from cvtgs.refinement import refine
    from cvtgs.rendering import Rendering, render
    from cvtgs.report import Level, Simplified, SimplifyReport
    from cvtgs.scene import GaussianScene
    from cvtgs.simplifier import Simplifier, simplify

__version__ = "0.2.0"

_HOME = {
    "Cameras": "cvtgs.cameras",
    "PRESETS": "cvtgs.config",
    "SimplifyConfig": "cvtgs.config",
    "EffectPlan": "cvtgs.analysis",
    "CvtgsError": "cvtgs.errors",
    "SceneInfo": "cvtgs.info",
    "describe": "cvtgs.info",
    "from_dict": "cvtgs.io",
    "load": "cvtgs.io",
    "load_cameras": "cvtgs.io",
    "save": "cvtgs.io",
    "evaluate": "cvtgs.evaluation",
    "refine": "cvtgs.refinement",
    "render": "cvtgs.rendering",
    "to_dict": "cvtgs.io",
    "ProgressEvent": "cvtgs.progress",
    "ProgressListener": "cvtgs.progress",
    "Rendering": "cvtgs.rendering",
    "SimplifyReport": "cvtgs.report",
    "GaussianScene": "cvtgs.scene",
    "concatenate": "cvtgs.edit",
    "Level": "cvtgs.report",
    "Prepared": "cvtgs.prepared",
    "Simplified": "cvtgs.report",
    "Simplifier": "cvtgs.simplifier",
    "simplify": "cvtgs.simplifier",
    "target_count": "cvtgs.counts",
}
__all__ = [
    "PRESETS",
    "Cameras",
    "CvtgsError",
    "EffectPlan",
    "GaussianScene",
    "Level",
    "Prepared",
    "ProgressEvent",
    "ProgressListener",
    "Rendering",
    "SceneInfo",
    "Simplified",
    "Simplifier",
    "SimplifyConfig",
    "SimplifyReport",
    "analysis",
    "boxes",
    "budget",
    "cells",
    "concatenate",
    "cvt",
    "describe",
    "edit",
    "errors",
    "evaluate",
    "evaluation",
    "filters",
    "from_dict",
    "io",
    "levels",
    "load",
    "load_cameras",
    "losses",
    "matching",
    "math",
    "mergenet",
    "outofcore",
    "pipeline",
    "refine",
    "refinement",
    "render",
    "rendering",
    "save",
    "simplify",
    "streams",
    "synthetic",
    "target_count",
    "to_dict",
    "tradeoff",
    "train",
    "validity",
    "views",
]
_MODULES = tuple(name for name in __all__ if name not in _HOME)


if not TYPE_CHECKING:  # or type checkers would accept any name

    def __getattr__(name: str) -> Any:
        if name in _MODULES:
            return import_module(f"cvtgs.{name}")
        if name not in _HOME:
            raise AttributeError(f"module 'cvtgs' has no attribute {name!r}")
        value = getattr(import_module(_HOME[name]), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
