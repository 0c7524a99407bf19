"""Run a command as a process of its own, and measure what it costs."""

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass

from cvtgs.errors import RunError


@dataclass(frozen=True, slots=True, kw_only=True)
class ProcessCost:
    """What one process cost, and what it said.

    Attributes:
        wall_seconds: Time from its start to its end.
        user_seconds: Processor time outside the kernel.
        peak_memory_bytes: Its largest resident size; 0 where the system does not tell (Windows).
        output: What it wrote to stdout.
        errors: What it wrote to stderr.
    """

    wall_seconds: float
    user_seconds: float
    peak_memory_bytes: int
    output: str
    errors: str


def run_process(command: Sequence[str]) -> ProcessCost:
    r"""Run a command to its end and measure it.

    If this call is interrupted, the process is ended first.
    """
    launcher = [sys.executable, "-S", "-c", LAUNCHER, *command]
    with subprocess.Popen(launcher, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        try:
            written = process.communicate()
        except BaseException:
            process.terminate()
            process.communicate()
            raise
    output, errors = (part.decode(errors="replace") for part in written)
    output, _, line = output.rstrip("\n").rpartition("\n")
    try:
        code, user, wall, peak = (float(word) for word in line.split())
    except ValueError:
        raise RunError(f"{command[0]} could not be started: {_last_line(errors)}.") from None
    if code:
        raise RunError(_reason(int(code), errors))
    unit = 1 if sys.platform == "darwin" else 1024
    return ProcessCost(
        wall_seconds=wall,
        user_seconds=user,
        peak_memory_bytes=int(peak) * unit,
        output=output,
        errors=errors,
    )


def _reason(code: int, errors: str) -> str:
    if code < 0:
        return f"it was ended by signal {-code}; 9 often means that memory ran out."
    return _last_line(errors) or f"it ended with exit code {code}."


def _last_line(errors: str) -> str:
    lines = [line for line in errors.splitlines() if line.strip()]
    return lines[-1].removeprefix("cvtgs: error: ") if lines else ""


# A process inherits the peak of the one that starts it, so a small one must start it. It hears of
# an interrupt and waits for its child, which hears of it too; an order to end is passed on.
LAUNCHER = """
import signal, subprocess, sys, time
signal.signal(signal.SIGINT, lambda *_: None)
start = time.perf_counter()
process = subprocess.Popen(sys.argv[1:])
signal.signal(signal.SIGTERM, lambda *_: process.terminate())
code = process.wait()
wall = time.perf_counter() - start
try:
    import resource
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    user, peak = usage.ru_utime, usage.ru_maxrss
except ImportError:
    user = peak = 0
sys.stdout.write(f"\\n{code} {user} {wall} {peak}\\n")
"""
