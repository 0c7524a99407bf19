"""Run a command in a process of its own, and measure its time and memory."""

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass

from cvtgs.errors import RunError, warn
from cvtgs.processes import SAFE_PATH

WARNING = "cvtgs: warning: "

START = """
import gc, cvtgs.cli.main, cvtgs.startup
cvtgs.startup.load_torch()
import cvtgs.config, cvtgs.io, cvtgs.mergenet, cvtgs.simplifier
gc.freeze()
"""
"""What every process does besides work on a scene: it loads modules as the command line does."""

# A process inherits the peak memory of its parent, so this small launcher starts the command. On an
# interrupt, which the child receives too, it keeps waiting for the child. When its own parent ends
# or closes the pipe, for whatever reason, it terminates the child.
LAUNCHER = """
import os, signal, subprocess, sys, threading, time
signal.signal(signal.SIGINT, lambda *_: None)
start = time.perf_counter()
process = subprocess.Popen(sys.argv[1:], stdin=subprocess.DEVNULL)
def end():
    os.read(0, 1)
    process.terminate()
threading.Thread(target=end, daemon=True).start()
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


@dataclass(frozen=True, slots=True, kw_only=True)
class ProcessCost:
    """The cost of one process, its stdout and its stderr; Windows reports no peak memory: 0."""

    wall_seconds: float
    user_seconds: float
    peak_memory_bytes: int
    output: str
    errors: str


def start_seconds() -> float:
    """Measure the seconds that a process takes before it reads a scene; the first may be cold."""
    return min(run_process([sys.executable, "-c", START]).wall_seconds for _ in range(2))


def pass_warnings_on(errors: str, warned: set[str]) -> None:
    """Repeat the warnings of a process, except those in ``warned``, which is updated."""
    for line in errors.splitlines():
        if line.startswith(WARNING) and line not in warned:
            warned.add(line)
            warn(line.removeprefix(WARNING))


def run_process(command: Sequence[str]) -> ProcessCost:
    """Run a command to its end, or until this call is interrupted, and measure it."""
    launcher = [sys.executable, "-S", "-c", LAUNCHER, *command]
    reading, writing = os.pipe()
    with os.fdopen(writing, "wb") as held:
        with os.fdopen(reading, "rb") as watched:
            process = subprocess.Popen(
                launcher,
                stdin=watched,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                # Python writes its output as UTF-8 on Windows too.
                env={**os.environ, "PYTHONIOENCODING": "utf-8", SAFE_PATH: "1"},
            )
        with process:
            try:
                written = process.communicate()
            except BaseException:
                held.close()
                process.communicate()
                raise
    texts = (part.decode(errors="replace") for part in written)
    output, errors = (text.replace("\r\n", "\n") for text in texts)
    output, _, line = output.rstrip("\n").rpartition("\n")
    try:
        code, user, wall, peak = (float(word) for word in line.split())
    except ValueError:
        raise RunError(f"{command[0]} could not be started: {_last_line(errors)}.") from None
    if code < 0:
        raise RunError(f"it was ended by signal {-code:.0f}; 9 often means that memory ran out.")
    if code:
        raise RunError(_last_line(errors) or f"it ended with exit code {code:.0f}.")
    unit = 1 if sys.platform == "darwin" else 1024
    return ProcessCost(
        wall_seconds=wall,
        user_seconds=user,
        peak_memory_bytes=int(peak) * unit,
        output=output,
        errors=errors,
    )


def _last_line(errors: str) -> str:
    lines = [line for line in errors.splitlines() if line.strip()]
    return lines[-1].removeprefix("cvtgs: error: ") if lines else ""
