"""``python -m cvtgs``."""

from cvtgs.cli.main import run_process

run_process()
