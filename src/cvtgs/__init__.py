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
    from cvtgs import cells, cvt, effects, errors, filters, io, math, synthetic
    from cvtgs.config import PRESETS, SimplifyConfig
    from cvtgs.effects import EffectPlan
    from cvtgs.errors import CvtgsError
    from cvtgs.info import SceneInfo, describe
    from cvtgs.io import from_dict, load, save, to_dict
    from cvtgs.progress import ProgressEvent, ProgressListener
    from cvtgs.report import SimplifyReport
    from cvtgs.scene import GaussianScene
    from cvtgs.simplify import Simplified, Simplifier, target_count

__version__ = "0.1.0"

_HOME = {
    "PRESETS": "cvtgs.config",
    "SimplifyConfig": "cvtgs.config",
    "EffectPlan": "cvtgs.effects",
    "CvtgsError": "cvtgs.errors",
    "SceneInfo": "cvtgs.info",
    "describe": "cvtgs.info",
    "from_dict": "cvtgs.io",
    "load": "cvtgs.io",
    "save": "cvtgs.io",
    "to_dict": "cvtgs.io",
    "ProgressEvent": "cvtgs.progress",
    "ProgressListener": "cvtgs.progress",
    "SimplifyReport": "cvtgs.report",
    "GaussianScene": "cvtgs.scene",
    "Simplified": "cvtgs.simplify",
    "Simplifier": "cvtgs.simplify",
    "target_count": "cvtgs.simplify",
}
_MODULES = ("cells", "cvt", "effects", "errors", "filters", "io", "math", "synthetic")

__all__ = [
    "PRESETS",
    "CvtgsError",
    "EffectPlan",
    "GaussianScene",
    "ProgressEvent",
    "ProgressListener",
    "SceneInfo",
    "Simplified",
    "Simplifier",
    "SimplifyConfig",
    "SimplifyReport",
    "cells",
    "cvt",
    "describe",
    "effects",
    "errors",
    "filters",
    "from_dict",
    "io",
    "load",
    "math",
    "save",
    "synthetic",
    "target_count",
    "to_dict",
]


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return import_module(f"cvtgs.{name}")
    if name not in _HOME:
        raise AttributeError(f"module 'cvtgs' has no attribute {name!r}")
    value = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
