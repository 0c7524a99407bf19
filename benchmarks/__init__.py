"""Scripts that measure every figure in the README and docs; run ``python -m benchmarks.X``."""

import sys
from types import TracebackType

from cvtgs.errors import CvtgsError


def _print_error(
    kind: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    """Print an error about an argument or a file as one sentence, like ``cvtgs``."""
    if issubclass(kind, CvtgsError):
        print(f"error: {error}", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


sys.excepthook = _print_error
