"""The program ``cvtgs``: parse the command line, run a command, turn errors into exit codes."""

import argparse
import errno
import gc
import io
import math
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from types import FrameType
from typing import NoReturn

from cvtgs.cli.completion import add_completion
from cvtgs.cli.demo import add_demo
from cvtgs.cli.display import flush_output, say
from cvtgs.cli.doctor import ShowVersions, add_doctor
from cvtgs.cli.evaluate import add_compare, add_evaluate, add_render, add_tradeoff
from cvtgs.cli.files import add_convert, add_info
from cvtgs.cli.jobs import STREAM, check_one_scene
from cvtgs.cli.levels import add_levels
from cvtgs.cli.options import CommandParser, read_axes
from cvtgs.cli.simplify import add_simplify
from cvtgs.cli.train import add_train
from cvtgs.cli.view import add_view
from cvtgs.errors import CvtgsError, InvalidArgumentError, memory_errors
from cvtgs.startup import load_torch
from cvtgs.text import printable_name

# Commands that write several files to one folder, which only one run at a time may do.
WRITE_SEVERAL = ("levels", "render", "compare", "tradeoff", "demo", "train")
PATIENCE = 2.0  # seconds in which a second signal is ignored
INTERRUPTED, PIPE_CLOSED = 130, 141  # exit status: 128 and the number of the signal
BLOCKS_ADVICE = "process a binary .ply in blocks with --memory AMOUNT, for example 2GB"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line and return its exit status."""
    stop = _Stop()
    before = {number: signal.signal(number, stop) for number in _stop_signals()}
    hook, sys.unraisablehook = sys.unraisablehook, stop.notice
    with warnings.catch_warnings():
        warnings.showwarning = _show_warning
        warnings.simplefilter("always", UserWarning)
        warnings.simplefilter("ignore", FutureWarning)  # of libraries, to their callers
        # Of a damaged checkpoint, before it is refused.
        warnings.filterwarnings("ignore", "TypedStorage is deprecated", module="torch")
        try:
            _run(sys.argv[1:] if arguments is None else arguments, stop)
        except (KeyboardInterrupt, Exception) as error:
            # An interrupted import may raise another error instead of KeyboardInterrupt.
            if stop.code is not None:
                signal.signal(signal.SIGINT, signal.SIG_IGN)  # a second Ctrl-C changes nothing
                if stop.code == INTERRUPTED:
                    say("cvtgs: interrupted; no incomplete file is left.", file=sys.stderr)
                return stop.code
            if not isinstance(error, CvtgsError):
                raise
            if _is_closed_pipe(error.__cause__):  # as in "cvtgs info | head"
                return PIPE_CLOSED
            say(printable_name(f"cvtgs: error: {error}"), file=sys.stderr)
            return 1
        finally:
            sys.unraisablehook = hook
            for number, handler in before.items():
                signal.signal(number, handler)
    return 0


def _stop_signals() -> list[signal.Signals]:
    """Return the signals that end a run; SIGHUP only by its default, which nohup changes."""
    numbers = [signal.SIGINT, signal.SIGTERM]
    if sys.platform != "win32" and signal.getsignal(signal.SIGHUP) == signal.SIG_DFL:
        numbers.append(signal.SIGHUP)
    return numbers


def _is_closed_pipe(error: BaseException | None) -> bool:
    """Return whether the reader of standard output has ended; Windows reports it differently."""
    if sys.platform == "win32" and isinstance(error, OSError):
        return error.errno in (errno.EPIPE, errno.EINVAL)
    return isinstance(error, BrokenPipeError)


def _run(words: Sequence[str], stop: "_Stop") -> None:
    parser = build_parser()
    if not words:
        parser.exit(2, parser.format_help())
    try:
        options = parser.parse_args(words)
    except SystemExit:  # after --help and --version, whose text may still be in a buffer
        flush_output()
        raise
    otherwise = BLOCKS_ADVICE if hasattr(options, "memory") else "ask for less"
    advice = f"free some, or {otherwise}, and use --device cpu if a GPU ran out"
    with memory_errors(f"cvtgs {options.command}", advice):
        if options.command != "completion":  # needs no tensors, and starts faster without them
            with stop.held():  # an interrupted import of torch may end in its C++ code
                load_torch()
        with _lock(options), _without_empty_folder(options):
            for name in ("input", "reference"):
                check_one_scene(getattr(options, name, ""))
                if str(getattr(options, name, "")) == STREAM and options.command != "info":
                    raise InvalidArgumentError(
                        f"{options.command} needs a file; simplify, convert and info read standard "
                        f"input (-)."
                    )
            if "axes" in options:
                options.axes = read_axes(options.axes)
            options.run(options)
    flush_output()


def _lock(options: argparse.Namespace) -> AbstractContextManager[None]:
    """Return a lock of the output folder if the command writes several files, else a no-op."""
    if options.command not in WRITE_SEVERAL:
        return nullcontext()
    from cvtgs.io.locks import folder_lock

    return folder_lock(options.output)


@contextmanager
def _without_empty_folder(options: argparse.Namespace) -> Iterator[None]:
    """After an error, remove the output folders that the command made and left empty."""
    folder = getattr(options, "folder", None) or getattr(options, "output", None) or Path()
    new = [
        path
        for path in (folder, *folder.parents)
        if not os.path.exists(path)  # noqa: PTH110 (false for impossible names)
    ]
    try:
        yield
    except BaseException:
        with suppress(OSError):
            for path in new:
                Path(os.path.realpath(path)).rmdir()  # of a link, what it leads to
        raise


def run_process() -> NoReturn:
    """Run the command line and end the process with its exit status."""
    _fill_closed_streams()
    for stream in (sys.stdout, sys.stderr):  # applies to output of libraries, too
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    code: int | str | None
    try:
        code = main()
    except SystemExit as stop:
        code = stop.code
    for number in _stop_signals():  # the exit status is final
        signal.signal(number, signal.SIG_IGN)
    for descriptor, file in ((1, sys.stdout), (2, sys.stderr)):
        try:
            if file is not None:
                file.flush()
        except OSError:  # already reported; Python would report it again at exit
            os.dup2(os.open(os.devnull, os.O_WRONLY), descriptor)
    gc.freeze()  # the process ends faster without a collection of everything it has loaded
    sys.exit(code)


def _fill_closed_streams() -> None:
    """Open standard streams that the parent process closed, so that no other file gets theirs."""
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest free number
    if sys.stderr is None:
        sys.stderr = Path(os.devnull).open("w")  # noqa: SIM115 (open until the process ends)


class _Stop:
    """A handler of signals that raises KeyboardInterrupt and records the exit status."""

    def __init__(self) -> None:
        self.code: int | None = None
        self.is_held = False
        self._raised = -math.inf

    def __call__(self, signum: int, frame: FrameType | None) -> None:
        if time.monotonic() - self._raised < PATIENCE:
            return  # a further signal would interrupt the wait for threads that still compute
        self.code = 128 + signum
        if not self.is_held:
            self._raise()

    def _raise(self) -> None:
        self._raised = time.monotonic()
        raise KeyboardInterrupt

    @contextmanager
    def held(self) -> Iterator[None]:
        """Raise at the end of the context what would be raised within it."""
        self.is_held = True
        try:
            yield
        finally:
            self.is_held = False
        if self.code is not None:
            self._raise()

    def notice(self, event: "sys.UnraisableHookArgs") -> None:
        """Send the signal again if its exception was raised where Python ignores exceptions."""
        if self.code is None:
            sys.__unraisablehook__(event)
            return
        if event.exc_type is KeyboardInterrupt:
            number = self.code - 128
            self._raised = -math.inf
            while True:
                with suppress(KeyboardInterrupt):  # on a busy machine, it comes before the end
                    again = threading.Timer(0.01, signal.raise_signal, (number,))
                    again.daemon = True
                    again.start()
                    return


def build_parser() -> CommandParser:
    """Build the parser of all commands and options."""
    parser = CommandParser(
        prog="cvtgs",
        description="Make trained 3D Gaussian Splatting scenes 10 to 1000 times smaller.",
        epilog="Start with: cvtgs demo",
    )
    parser.add_argument(
        "--version",
        action=ShowVersions,
        nargs=0,
        help="print the versions of cvtgs, Python and the packages used for computation",
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for add in (
        add_simplify,
        add_levels,
        add_convert,
        add_info,
        add_evaluate,
        add_render,
        add_compare,
        add_view,
        add_tradeoff,
        add_demo,
        add_doctor,
        add_train,
    ):
        add(commands.add_parser)
    add_completion(commands.add_parser, commands.choices)
    return parser


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    say(printable_name(f"cvtgs: warning: {message}"), file=sys.stderr)
