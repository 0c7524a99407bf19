"""The entry point of ``python -m cvtgs`` and of the command ``cvtgs``."""

import os
import signal
from types import FrameType
from typing import NoReturn


def run() -> NoReturn:
    """Run the command line; an interrupt during its import prints no traceback either."""
    signal.signal(signal.SIGINT, _leave)
    from cvtgs.cli.main import run_process  # noqa: PLC0415 (takes time to load)

    run_process()


def _leave(signum: int, frame: FrameType | None) -> None:
    os.write(2, b"cvtgs: interrupted; nothing was written.\n")
    os._exit(130)


if __name__ == "__main__":
    run()
