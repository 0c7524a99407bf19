"""The cost model of this machine, measured once and kept in the user's cache."""

import hashlib
import json
import os
import platform
import sys
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

import pydantic
import torch

import cvtgs
from cvtgs.budget.calibrate import CANDIDATES, calibrate, measured_seconds
from cvtgs.budget.cost_model import CostModel
from cvtgs.config import PRESETS, SimplifyConfig
from cvtgs.devices import chosen_device, device_name
from cvtgs.errors import OutputError
from cvtgs.io import atomic_output
from cvtgs.progress import ProgressListener, silent

RENDERERS = ("gsplat", "numba")
"""Packages that render faster than torch; importing one to ask takes longer than many a run."""

VERSION: Literal[2] = 2
"""Of the file; raised when features change, so that older files are measured anew."""

STALE_SECONDS = 90 * 24 * 3600.0
"""Machines change: drivers, limits, neighbours."""

Calibration = Callable[[], CostModel]


class _Record(pydantic.BaseModel):
    """What the file holds."""

    model_config = pydantic.ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    version: Literal[2]
    key: dict[str, str]
    made: float
    model: CostModel


def cost_model(
    device: str | torch.device = "auto",
    *,
    recalibrate: bool = False,
    calibration: Calibration | None = None,
    folder: Path | None = None,
    listener: ProgressListener = silent,
) -> CostModel:
    """Return what presets cost on this machine; the first call measures it and remembers it.

    It is measured anew when the machine, the device, the number of threads, the versions of torch
    or cvtgs, or the presets are others, after 90 days, and when the file is damaged. Where nothing
    can be written, it is measured for this call only.

    Args:
        device: Where presets compute.
        recalibrate: Whether to measure anew in any case.
        calibration: Measures; None for the real one, which takes about a minute.
        folder: Where to remember; None for ``cvtgs`` in the user's cache folder.
        listener: Told about the measurements.

    Returns:
        The model.

    Raises:
        DeviceError: There is no such device.

    Example:
        >>> import tempfile
        >>> rates = {"standard": {"check": {"in": 1e-6, "in_values": 0.0}}}
        >>> with tempfile.TemporaryDirectory() as name:
        ...     model = cost_model(calibration=lambda: CostModel(rates=rates), folder=Path(name))
        >>> model.presets
        ('standard',)
    """
    where = chosen_device(device)
    key = machine_key(where)
    path = _path(key, folder)
    known = None if recalibrate else _recall(path, key)
    if known is not None:
        return known
    found = calibration() if calibration else calibrate(measured_seconds(where), listener=listener)
    _remember(path, _Record(version=VERSION, key=key, made=time.time(), model=found))
    return found


def is_known(device: str | torch.device = "auto", *, folder: Path | None = None) -> bool:
    """Report whether the cost model of this machine is remembered."""
    key = machine_key(chosen_device(device))
    return _recall(_path(key, folder), key) is not None


def machine_key(device: torch.device) -> dict[str, str]:
    """Return everything that seconds depend on."""
    presets = {name: SimplifyConfig.from_preset(name).model_dump(mode="json") for name in PRESETS}
    return {
        "system": f"{platform.system()} {platform.machine()}",
        "processor": device_name(torch.device("cpu")),
        "cores": str(os.cpu_count()),
        "threads": str(torch.get_num_threads()),
        "device": "cpu" if device.type == "cpu" else device_name(device),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "cvtgs": cvtgs.__version__,
        "renderers": ", ".join(name for name in RENDERERS if find_spec(name)),
        "presets": _digest(presets),
    }


def cache_folder() -> Path:
    """Return the folder of cvtgs in the user's cache."""
    named = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA")
    if named:
        return Path(named) / "cvtgs"
    home = Path(os.path.expanduser("~"))  # noqa: PTH111 (Path.home() fails where there is none)
    return home / ("Library/Caches" if sys.platform == "darwin" else ".cache") / "cvtgs"


def _path(key: dict[str, str], folder: Path | None) -> Path:
    return (folder or cache_folder()) / f"cost-{_digest(key)}.json"


def _digest(value: object) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]


def _recall(path: Path, key: dict[str, str]) -> CostModel | None:
    """Read what is remembered; None if that is nothing, damaged, stale, or of another machine."""
    try:
        record = _Record.model_validate_json(path.read_bytes())
    except (OSError, ValueError):
        return None
    fresh = 0 <= time.time() - record.made < STALE_SECONDS
    complete = record.model.presets == CANDIDATES
    return record.model if fresh and complete and record.key == key else None


def _remember(path: Path, record: _Record) -> None:
    """Write it down if that is possible; if not, the next process measures again."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_output(path, overwrite=True) as file:
            file.write(record.model_dump_json(indent=2).encode())
    except (OSError, OutputError):
        return
