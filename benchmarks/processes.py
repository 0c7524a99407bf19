"""Run whole processes and measure what they cost."""

import os
import platform
import statistics
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True, kw_only=True)
class Cost:
    """What one process cost, its children not included.

    Attributes:
        user_seconds: Processor time outside the kernel.
        wall_seconds: Time from start to end.
        peak_bytes: Largest resident size.
        output: What it wrote to stdout.
    """

    user_seconds: float
    wall_seconds: float
    peak_bytes: int
    output: str


def run_python(*arguments: str) -> Cost:
    """Run this Python with arguments, and measure."""
    return run([sys.executable, *arguments])


def run(command: Sequence[str]) -> Cost:
    """Run a command and measure it; a failure ends the benchmark."""
    launched = subprocess.run(
        [sys.executable, "-S", "-c", LAUNCHER, *command], stdout=subprocess.PIPE, check=False
    )
    output, _, line = launched.stdout.decode().rstrip("\n").rpartition("\n")
    code, user, wall, peak = (float(number) for number in line.split())
    if code:
        raise SystemExit(f"{' '.join(command)} failed with exit code {code:.0f}.")
    unit = 1 if sys.platform == "darwin" else 1024
    return Cost(user_seconds=user, wall_seconds=wall, peak_bytes=int(peak) * unit, output=output)


# A process inherits the peak of the one that starts it, so a small one must start it.
LAUNCHER = """
import os, sys, time
start = time.perf_counter()
process = os.spawnvp(os.P_NOWAIT, sys.argv[1], sys.argv[1:])
_, status, usage = os.wait4(process, 0)
wall = time.perf_counter() - start
print(f"\\n{os.waitstatus_to_exitcode(status)} {usage.ru_utime} {wall} {usage.ru_maxrss}")
"""


def spread(values: Sequence[float]) -> str:
    """Give median, smallest and largest."""
    return f"{statistics.median(values):.2f} ({min(values):.2f}-{max(values):.2f})"


def machine() -> str:
    """Name the machine."""
    model = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    model = names[0] if names else model
    return f"{model}, {os.cpu_count()} cores, Python {platform.python_version()}"
