"""Run whole processes and measure what they cost."""

import os
import platform
import statistics
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cvtgs.errors import RunError
from cvtgs.tradeoff.runs import run_process


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
    try:
        cost = run_process(command)
    except RunError as error:
        raise SystemExit(f"{' '.join(command)} failed: {error}") from None
    sys.stderr.write(cost.errors)
    return Cost(
        user_seconds=cost.user_seconds,
        wall_seconds=cost.wall_seconds,
        peak_bytes=cost.peak_memory_bytes,
        output=cost.output,
    )


def spread(values: Sequence[float]) -> str:
    """Return median, smallest and largest."""
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
