"""Scenes that a command reads and writes: one, many into a directory, or standard streams."""

import argparse
import gc
import glob
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import cvtgs
from cvtgs.cli.display import WIDTH, say, say_wrapped, send_file
from cvtgs.cli.options import READABLE, WRITABLE, CommandParser, dotted
from cvtgs.cli.paths import folder_or_file, is_same_file, names_file
from cvtgs.errors import (
    CvtgsError,
    InputError,
    InputNotFoundError,
    InvalidArgumentError,
    OutputError,
    RunError,
)
from cvtgs.io.atomic import make_folder
from cvtgs.io.streams import file_of, named_in_warnings
from cvtgs.text import counted, printable_name, shortened, shown, size_text

STREAM = "-"  # the path that stands for standard input or output

STANDARD_INPUT, STANDARD_OUTPUT = "standard input", "standard output"
_OTHER_FORMATS = "save a scene in another format as a file, whose suffix gives the format"


class Outcome(NamedTuple):
    """The result of a command for one scene, as texts such as ``500 -> 50 Gaussians``."""

    counts: str
    seconds: str = ""
    notes: Sequence[str] = ()

    def facts(self, before: int, after: int | None) -> str:
        """Return counts, bytes and seconds in one line; None if the output was moved away."""
        sizes = f"{size_text(before)} -> {'moved away' if after is None else size_text(after)}"
        return ", ".join(filter(None, (self.counts, sizes, self.seconds)))


def add_paths(parser: CommandParser, *, options: str) -> None:
    """Add IN and OUT, or many IN and -o DIR, to a command, and their check."""
    parser.check = check_paths
    parser.usage = (
        f"{parser.prog} IN OUT {options}[options]\n       {parser.prog} IN [IN ...] -o DIR "
        f"{options}[options]"
    )
    parser.add_argument(
        "paths",
        nargs="+",
        metavar="IN OUT",
        help=f"scene to read ({READABLE}) and scene to write ({WRITABLE}); - is standard input or "
        "output. With -o, any number of scenes to read; patterns such as 'scans/*.ply' and "
        "folders of scenes are expanded",
    )
    parser.add_argument(
        "-o",
        "--output",
        dest="folder",
        type=folder_or_file,
        metavar="DIR",
        help="directory to write to; each scene keeps its name (the name of a file, such as "
        "small.ply, is OUT of one scene)",
    )
    parser.add_argument(
        "--suffix",
        type=dotted,
        metavar="END",
        help="format, for example .spz, of the scenes in DIR (default: the format of IN if it can "
        "be written, else .ply) or on standard output (default: .ply)",
    )


def check_paths(parser: CommandParser, options: argparse.Namespace) -> None:
    """Exit with a usage error if the paths do not match the use of -o and --suffix."""
    if "" in options.paths:
        parser.error("IN and OUT must be paths, found ''")
    if options.folder is not None and names_file(options.folder):
        if len(options.paths) != 1:
            scenes = counted(len(options.paths), "scene")
            parser.error(f"-o must be a folder for {scenes}, found {str(options.folder)!r}")
        options.paths, options.folder = [*options.paths, str(options.folder)], None
    if options.folder is not None:
        if STREAM in options.paths:
            parser.error("- cannot be used with -o DIR; give IN and OUT")
        return
    if len(options.paths) != 2:
        found = f"{counted(len(options.paths), 'path')} ({shortened(', '.join(options.paths), 60)})"
        parser.error(
            f"give IN and OUT, or any number of IN and -o DIR to write into a folder; found {found}"
        )
    target = options.paths[1]
    if os.path.isdir(target) or target.endswith(("/", os.sep)):  # noqa: PTH112 (any path)
        parser.error(f"OUT must be a file; to write into a folder, use -o {target}")
    if "." not in Path(target).name and target != STREAM:
        parser.error(
            f"OUT must end in the suffix of a format, such as {target}.ply; to write into a "
            f"folder, use -o {target}"
        )
    if options.suffix and target != STREAM:
        parser.error("--suffix needs -o DIR or - as OUT; otherwise the name of OUT sets the format")


@contextmanager
def open_jobs(options: argparse.Namespace) -> Iterator[list[argparse.Namespace]]:
    """Return the options of a command for each of its scenes, with ``input`` and ``output``.

    With ``to_stream``, the output is copied to standard output. Standard streams are temporary
    files within the context.
    """
    check_suffix(options.suffix)
    if options.folder is not None:
        yield _folder_jobs(options)
        return
    source, target = options.paths
    check_one_scene(source, "to write into a folder, use -o DIR")
    to_stream = target == STREAM
    with ExitStack() as stack:
        if to_stream:
            if sys.stdout is None or sys.stdout.isatty():
                found = "none" if sys.stdout is None else "a terminal"
                raise OutputError(f"standard output must be a pipe or a file, found {found}.")
            folder = stack.enter_context(TemporaryDirectory(prefix="cvtgs-"))
            target = f"{folder}/standard-output{options.suffix or '.ply'}"
            stack.enter_context(named_in_warnings(Path(target), STANDARD_OUTPUT))
        file = stack.enter_context(input_file(source))
        try:
            yield [_with_paths(options, file, Path(target), to_stream=to_stream)]
        except OutputError as error:
            if not (to_stream and str(target) in str(error)):
                raise
            reason = str(error).rpartition("found: ")[2]
            raise OutputError(
                "the folder of temporary files must be writable and have room for the output, "
                f"found: {reason.removesuffix('.')}; TMPDIR sets another folder."
            ) from error


def _with_paths(
    options: argparse.Namespace, source: Path, target: Path, *, to_stream: bool = False
) -> argparse.Namespace:
    own = {"input": source, "output": target, "to_stream": to_stream}
    return argparse.Namespace(**{**vars(options), **own})


@contextmanager
def input_file(source: str | Path) -> Iterator[Path]:
    """Return the path of a scene; standard input is a temporary file within the context."""
    if str(source) != STREAM:
        yield Path(source)
        return
    if sys.stdin is None or sys.stdin.isatty():
        found = "none" if sys.stdin is None else "a terminal"
        raise InputError(f"standard input must be a pipe or a file, found {found}.")
    with file_of(sys.stdin.buffer, name=STANDARD_INPUT, advice=_OTHER_FORMATS) as path:
        yield path


def check_suffix(suffix: str | None) -> None:
    """Raise if ``--suffix`` names no format that can be written."""
    from cvtgs.io.formats import WRITABLE_SUFFIXES

    if suffix is not None and not suffix.lower().endswith(WRITABLE_SUFFIXES):
        *others, last = WRITABLE_SUFFIXES
        raise InvalidArgumentError(
            f"--suffix must end in {', '.join(others)} or {last}, found {shown(suffix)}."
        )


def run_jobs(
    jobs: Sequence[argparse.Namespace],
    work: Callable[[argparse.Namespace], Outcome],
    failed: Callable[[argparse.Namespace, CvtgsError], None] = lambda job, error: None,
) -> None:
    """Call ``work`` for every scene and print the results; go on if one of many has ``failed``."""
    folder, quiet, failures = jobs[0].folder, jobs[0].quiet, 0
    if folder is None:
        _run_one(jobs[0], work)
        return
    before = after = 0
    for number, job in enumerate(jobs, start=1):
        source, target = job.input, job.output
        place = f"[{number:>{len(str(len(jobs)))}}/{len(jobs)}] "
        outcome = None
        try:
            bytes_in = cvtgs.io.scene_size(source)
            outcome = work(job)
        except CvtgsError as error:
            failed(job, error)
            name = "" if str(error).startswith(str(source)) else f"{source}: "
            say(printable_name(f"cvtgs: error: {place}{name}{error}"), file=sys.stderr)
        if outcome is None:
            failures += 1
            gc.collect()  # the error and its frames refer to each other, and hold the scene
            continue
        bytes_out = _size_of_output(target)
        before, after = before + bytes_in, after + (bytes_out or 0)
        if not quiet:
            facts = outcome.facts(bytes_in, bytes_out)
            room = max(8, WIDTH - len(place) - len(facts) - 2)
            say(f"{place}{shortened(printable_name(target.name), room)}: {facts}", flush=True)
            for note in outcome.notes:
                say_wrapped(note, indent=len(place))
    done = len(jobs) - failures
    if failures:
        are = "is" if done == 1 else "are"
        raise RunError(
            f"{failures} of {counted(len(jobs), 'scene')} failed; {done} {are} in {folder}."
        )
    if not quiet:
        scenes = counted(done, "scene")
        say(f"{scenes} in {folder}, {size_text(before)} -> {size_text(after)}")


def _run_one(options: argparse.Namespace, work: Callable[[argparse.Namespace], Outcome]) -> None:
    before = cvtgs.io.scene_size(options.input)
    outcome = work(options)
    facts = outcome.facts(before, _size_of_output(options.output))
    stream, name = sys.stdout, printable_name(str(options.output))
    if options.to_stream:
        stream, name = sys.stderr, STANDARD_OUTPUT
        send_file(options.output)
    if options.quiet:
        return
    for note in outcome.notes:
        say_wrapped(note, file=stream)
    if len(name) + len(facts) + 2 > WIDTH:
        say(facts, file=stream)
        say(name, file=stream)
    else:
        say(f"{name}: {facts}", file=stream)


def _size_of_output(path: Path) -> int | None:
    """Return the bytes of a scene that was written; None if another program has moved it since."""
    try:
        return cvtgs.io.scene_size(path)
    except InputError:
        return None


def _folder_jobs(options: argparse.Namespace) -> list[argparse.Namespace]:
    """Return the options for every input; raise if two would write the same file."""
    sources = expanded(options.paths)
    ignores_case = sys.platform in ("darwin", "win32")
    named: dict[str, Path] = {}
    jobs = []
    for source in sources:
        name = _output_name(source, options.suffix)
        before = named.setdefault(name.lower() if ignores_case else name, source)
        if before is not source and before == source:
            raise InvalidArgumentError(f"every scene must be given once, found {source} twice.")
        if before is not source:
            raise InvalidArgumentError(
                f"two scenes must not have the same name in {options.folder}, found "
                f"{before} and {source}."
            )
        jobs.append(_with_paths(options, source, options.folder / name))
    for one in jobs:
        for other in [*sources, *getattr(options, "merge", ())]:
            if other != one.input and is_same_file(one.output, other):
                raise InvalidArgumentError(
                    f"the output of {one.input} must not replace another input, found {one.output}."
                )
    make_output_folder(options)
    return jobs


def make_output_folder(options: argparse.Namespace) -> None:
    """Make the folder of ``-o`` unless it is there; a failed run removes one that it made."""
    if options.folder is not None:
        make_folder(options.folder)


def expanded(patterns: Iterable[str | Path]) -> list[Path]:
    """Expand folders of scenes, and patterns that the shell left unexpanded as on Windows."""
    paths = []
    for pattern in map(str, patterns):
        found = [pattern]
        if glob.has_magic(pattern) and not os.path.lexists(pattern):
            found = sorted(glob.glob(pattern, recursive=True))  # noqa: PTH207 (any pattern)
        if not found:
            raise InputNotFoundError(f"{pattern}: the pattern must match a file, found none.")
        paths += [Path(path) for one in found for path in _in_folder(one)]
    return paths


def _in_folder(folder: str) -> list[str]:
    """Return the scenes in a folder, or the path itself if it is a scene or no folder."""
    from cvtgs.io.formats import READABLE_SUFFIXES

    if not os.path.isdir(folder) or _is_scene(folder):  # noqa: PTH112 (any path)
        return [folder]
    found = sorted(glob.glob(f"{glob.escape(folder)}/*"))  # noqa: PTH207 (as text)
    scenes = [
        path
        for path in found
        if path.lower().endswith(READABLE_SUFFIXES) or (os.path.isdir(path) and _is_scene(path))  # noqa: PTH112 (any path)
    ]
    is_tiled = os.path.isfile(f"{folder}/tileset.json")  # noqa: PTH113 (any path)
    if is_tiled and all(path.lower().endswith(".glb") for path in scenes):
        raise InputError(
            f"{folder}: must be a scene or a folder of scenes, found 3D Tiles (tileset.json), "
            "whose files are parts of a scene; cvtgs only writes them."
        )
    return scenes or [folder]


def _is_scene(folder: str) -> bool:
    """Return whether a folder is a scene, such as that of a trained model or with a meta.json."""
    try:
        cvtgs.io.scene_file(folder)
    except InputError:
        return False
    return True


def check_one_scene(path: str | Path, advice: str = "") -> None:
    """Raise an error with advice if a path is a folder of scenes, and not a scene itself."""
    found = _in_folder(str(path))
    if found != [str(path)]:
        raise InputError(
            f"{path}: must be one scene, found a folder of {counted(len(found), 'scene')}; "
            f"{advice or f'give one of them, for example {found[0]}'}."
        )


def _output_name(source: Path, suffix: str | None) -> str:
    """Return the file name for the output of a scene, with the suffix that sets its format."""
    from cvtgs.io.formats import READABLE_SUFFIXES, WRITABLE_SUFFIXES

    if source.name in ("meta.json", "lod-meta.json"):
        source = source.parent
    name = source.resolve().name if source.is_dir() else source.name
    own = next(
        (end for end in (*WRITABLE_SUFFIXES, *READABLE_SUFFIXES) if name.lower().endswith(end)), ""
    )
    end = suffix or (own if own in WRITABLE_SUFFIXES else ".ply")
    return name[: len(name) - len(own)] + end
