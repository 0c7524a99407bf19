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
        analysis as analysis,
        boxes as boxes,
        budget as budget,
        cameras as cameras,
        cells as cells,
        clock as clock,
        config as config,
        counts as counts,
        cvt as cvt,
        edit as edit,
        errors as errors,
        evaluation as evaluation,
        filters as filters,
        grouping as grouping,
        info as info,
        io as io,
        levels as levels,
        losses as losses,
        matching as matching,
        math as math,
        mergenet as mergenet,
        outofcore as outofcore,
        pipeline as pipeline,
        prepared as prepared,
        progress as progress,
        refinement as refinement,
        rendering as rendering,
        report as report,
        scene as scene,
        simplifier as simplifier,
        startup as startup,
        streams as streams,
        synthetic as synthetic,
        tradeoff as tradeoff,
        train as train,
        validity as validity,
        viewer as viewer,
        views as views,
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
    "concatenate",
    "describe",
    "evaluate",
    "from_dict",
    "load",
    "load_cameras",
    "refine",
    "render",
    "save",
    "simplify",
    "target_count",
    "to_dict",
]
_MODULES = (
    "analysis",
    "boxes",
    "budget",
    "cameras",
    "cells",
    "clock",
    "config",
    "counts",
    "cvt",
    "edit",
    "errors",
    "evaluation",
    "filters",
    "grouping",
    "info",
    "io",
    "levels",
    "losses",
    "matching",
    "math",
    "mergenet",
    "outofcore",
    "pipeline",
    "prepared",
    "progress",
    "refinement",
    "rendering",
    "report",
    "scene",
    "simplifier",
    "startup",
    "streams",
    "synthetic",
    "tradeoff",
    "train",
    "validity",
    "viewer",
    "views",
)


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
    return sorted([*__all__, *_MODULES, "__version__"])
