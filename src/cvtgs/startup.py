"""Start of a process: load torch without the waits that its defaults cause.

For programs, not for libraries: the settings apply to the whole process.
"""

import gc
import os
import sys

__all__ = ["load_torch"]


def load_torch() -> None:
    """Load torch, if it is not loaded, with settings for a process that ends with its work.

    Garbage collections find nothing while modules load, nor among their objects when the process
    ends, but take time; so none run meanwhile, and objects that exist after loading are excluded.

    Idle OpenMP threads sleep after a moment, unless the user has set a policy. By default they spin
    for long, and take the time from threads that compute where other programs need a core, too; if
    they never spin, waking them takes longer than many small operations.
    """
    if "torch" in sys.modules:
        return
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ["OMP_WAIT_POLICY"] = "PASSIVE"
        os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        import torch  # noqa: F401, PLC0415 (the settings come first)
    finally:
        if was_enabled:
            gc.enable()
    gc.freeze()
