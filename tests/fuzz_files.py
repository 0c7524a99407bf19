"""Fuzz the readers: scenes of every format, networks and configurations, damaged in every way.

``python tests/fuzz_files.py --count 100000`` (the nox session ``fuzz``) prints a line of counts,
and the inputs that gave neither a result nor one clear sentence: these are reduced and stored in
``tests/data/fuzz``, which the tests read. Inputs with an outcome not seen before are damaged
further. The CPU time of each input and the memory of the process are limited, so hangs and
false headers are found.
"""

import argparse
import gzip
import hashlib
import io
import os
import random
import re
import signal
import sys
import tempfile
import time
import warnings
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import torch

from cvtgs.errors import CvtgsError, DroppedDataWarning
from fuzz_seeds import READERS, place

Dice = random.Random
CORPUS = Path(__file__).parent / "data" / "fuzz"
CPU_SECONDS = 2.0
MEMORY = 1 << 30
"""Memory limit above that of the process at its start; no seed has more than 100 kB."""

MOST_GROWN, MOST_FAILURES, MOST_TRIES = 300, 10, 400
"""Most inputs added to the seeds of a kind, failures before the end, tries to reduce one."""

LIES = (b"-1", b"0", b"1", b"7", b"4294967296", b"999999999999999999", b"9" * 40, b"1e3", b"0x10")
WORDS = (
    b"nan", b"inf", b"-inf", b"1e999", b"1e-999", b"0x1p3", b"--1", b"", b" ", b"\n", b"\r\n",
    b"\x00", b"\xff\xff\xff\xff", b"\x7f", b"9" * 400, b"list uint float",
    b"property list uint int a", b"element vertex 1000000000", b"end_header\n", b"comment ",
    b"double", b"int64", b"[[]]", b"{}",
    b"=", b"[a]\n", b'"""', "\u00fc\u2028".encode(), b"format ascii 1.0\n", b"e", b"-",
    b"[" * 2000,
)  # fmt: skip


class HangError(Exception):
    """Reading an input takes too long."""


def mutant(seed: bytes, dice: Dice) -> bytes:
    """Damage an input in one to four ways."""
    data = bytearray(seed)
    for _ in range(dice.choice((1, 1, 2, 4))):
        data = bytearray(dice.choice(DAMAGES)(data, dice))
    return bytes(data)


def flip(data: bytearray, dice: Dice) -> bytes:
    """Flip some bits."""
    for _ in range(dice.choice((1, 1, 3, 20)) if data else 0):
        data[dice.randrange(len(data))] ^= 1 << dice.randrange(8)
    return data


def cut(data: bytearray, dice: Dice) -> bytes:
    """Cut off the end, or cut out a piece."""
    start = dice.randrange(len(data) + 1)
    stop = dice.choice((len(data), min(len(data), start + dice.randrange(40))))
    return data[:start] + data[stop:]


def insert(data: bytearray, dice: Dice) -> bytes:
    """Insert a word anywhere, or replace a few bytes by it."""
    at = dice.randrange(len(data) + 1)
    return data[:at] + dice.choice(WORDS) + data[at + dice.randrange(8) :]


def lie(data: bytearray, dice: Dice) -> bytes:
    """Replace a number of the text."""
    numbers = list(re.finditer(rb"\d+", bytes(data[:4000])))
    if not numbers:
        return data
    number = dice.choice(numbers)
    return data[: number.start()] + dice.choice(LIES) + data[number.end() :]


def swap_lines(data: bytearray, dice: Dice) -> bytes:
    """Drop, repeat or exchange lines."""
    lines = bytes(data).split(b"\n")
    one, other = dice.randrange(len(lines)), dice.randrange(len(lines))
    way = dice.randrange(3)
    if way == 0:
        lines[one], lines[other] = lines[other], lines[one]
    elif way == 1:
        lines.insert(one, lines[other])
    else:
        del lines[one]
    return b"\n".join(lines)


def swap_words(data: bytearray, dice: Dice) -> bytes:
    """Replace one word of the text by another."""
    words = list(re.finditer(rb"[\w.+-]+", bytes(data[:4000])))
    if not words:
        return data
    one, other = dice.choice(words), dice.choice((*words,))
    return data[: one.start()] + other[0] + data[one.end() :]


def inside(data: bytearray, dice: Dice) -> bytes:
    """Damage compressed content, and compress it again with correct checksums."""
    whole = bytes(data)
    try:
        if whole[:2] == b"\x1f\x8b":
            return gzip.compress(plainly(gzip.decompress(whole), dice), 1, mtime=0)
        if whole[:2] != b"PK":
            return plainly(whole, dice)
        with zipfile.ZipFile(io.BytesIO(whole)) as archive:
            names = archive.namelist()
            contents = {name: archive.read(name) for name in names}
        name = dice.choice(names)
        contents[name] = plainly(contents[name], dice)
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w") as archive:
            for entry, content in contents.items():
                archive.writestr(zipfile.ZipInfo(entry), content)
        return file.getvalue()
    except (OSError, EOFError, ValueError, IndexError, KeyError, RuntimeError, UnicodeError):
        return whole
    except (zipfile.BadZipFile, zlib.error, NotImplementedError):
        return whole


def plainly(data: bytes, dice: Dice) -> bytes:
    return dice.choice(PLAIN)(bytearray(data), dice)


PLAIN: Sequence[Callable[[bytearray, Dice], bytes]] = (
    flip, cut, insert, lie, lie, swap_lines, swap_words
)  # fmt: skip

DAMAGES: Sequence[Callable[[bytearray, Dice], bytes]] = (
    *PLAIN, inside, inside, inside
)  # fmt: skip


class Verdict(NamedTuple):
    """The outcome of reading: ``read``, ``refused`` or the fault; and a signature of its text."""

    end: str
    signature: str


def verdict(read: Callable[[Path], object], path: Path) -> str:
    """Read a file; return ``read``, ``refused`` or the fault."""
    return judged(read, path).end


def judged(read: Callable[[Path], object], path: Path) -> Verdict:
    """Read a file and return the verdict on the outcome."""
    text = "read"
    before = sorted(path.parent.iterdir())
    set_timer(CPU_SECONDS)
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            # From torch, as it refuses a checkpoint. Only filters of the process could hide it,
            # which threads of a program would spoil for each other.
            warnings.filterwarnings("ignore", "TypedStorage is deprecated")
            read(path)
        result = "read"
    except MemoryError:
        result = f"more than {MEMORY >> 20} MiB"
    except CvtgsError as error:
        text = str(error)
        own = (f"{path}: ", f"{path.parent}: ", f"{path.parent}{os.sep}")  # or a file beside it
        clear = text.startswith(own) and text.endswith((".", "?")) and "\n" not in text
        result = "refused" if clear and len(text) < 1000 else f"unclear: {text!r}"
    except HangError:
        result = f"more than {CPU_SECONDS:g} s"
    except Exception as error:  # any error that is not of cvtgs is a fault
        result = f"{type(error).__name__}: {error}"
    finally:
        set_timer(0)
    if any(w.category is not DroppedDataWarning for w in caught) or len(caught) > 1:
        result = f"warnings: {[str(w.message) for w in caught]}"
    if sorted(path.parent.iterdir()) != before:
        result = "files were written"
    return Verdict(result, re.sub(r"'[^']*'|\d+", "#", text.replace(str(path), "")))


def set_timer(seconds: float) -> None:
    """Request a signal after some seconds of CPU time, where the system supports it."""
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_PROF, seconds)


def limit() -> None:
    """Limit the memory of the process, and stop inputs that take too long."""
    import resource  # noqa: PLC0415 (not on Windows)

    def stop(number: int, frame: object) -> None:
        raise HangError

    signal.signal(signal.SIGPROF, stop)
    torch.set_num_threads(1)
    status = Path("/proc/self/status").read_text(encoding="ascii")
    now = 1024 * int(re.search(r"VmSize:\s+(\d+) kB", status)[1])  # type: ignore[index]
    resource.setrlimit(resource.RLIMIT_AS, (now + MEMORY, now + MEMORY))


def made_small(data: bytes, fails: Callable[[bytes], bool]) -> bytes:
    """Drop pieces of an input, long ones first, while it still fails."""
    tries, size = 0, max(1, len(data) // 2)
    while tries < MOST_TRIES:
        for start in range(0, len(data), size):
            shorter = data[:start] + data[start + size :]
            tries += 1
            if fails(shorter):
                data = shorter
                break
            if tries >= MOST_TRIES:
                return data
        else:
            if size == 1:
                return data
            size = max(1, size // 2)
    return data


def chosen(pool: Sequence[bytes], whole: int, dice: Dice) -> bytes:
    """Choose a seed: an undamaged file (first in the pool) twice as often as a damaged one."""
    return dice.choice(pool[:whole] if dice.random() < 2 / 3 else pool)


def corpus(kind: str) -> list[Path]:
    """Return the stored inputs of a kind."""
    return sorted((CORPUS / kind).glob("*"))


def suffix_of(kind: str) -> str:
    name = READERS[kind].name
    return name if name.startswith(".") else Path(name).suffix


def keep(kind: str, data: bytes) -> Path:
    """Store an input with the tests."""
    path = CORPUS / kind / f"{hashlib.sha256(data).hexdigest()[:12]}{suffix_of(kind)}"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path


def main() -> None:
    """Fuzz all readers, and print the outcomes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=100_000, help="total number of inputs")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="end after this time")
    parser.add_argument("--kinds", nargs="*", choices=[*READERS], help="kinds of files (all)")
    parser.add_argument(
        "--grow", type=int, default=0, help="new outcomes per kind to store with the tests"
    )
    options = parser.parse_args()
    dice, ends = random.Random(options.seed), Counter[str]()
    kinds = options.kinds or [*READERS]
    pools = {kind: READERS[kind].seeds() for kind in kinds}
    whole = {kind: len(pool) for kind, pool in pools.items()}
    known: dict[str, set[str]] = {kind: set() for kind in kinds}
    failures = []
    with tempfile.TemporaryDirectory() as folder:
        paths = {kind: place(kind, Path(folder)) for kind in kinds}
        for kind, pool in pools.items():
            for number, seed in enumerate(pool):
                paths[kind].write_bytes(seed)
                if verdict(READERS[kind].read, paths[kind]) != "read":
                    sys.exit(f"{kind} {number} must be readable before it is damaged.")
            pool += [path.read_bytes() for path in corpus(kind)]
        limit()
        begun = time.monotonic()
        for number in range(options.count):
            if time.monotonic() - begun > options.seconds:
                break
            kind = kinds[number % len(kinds)]
            path, read = paths[kind], READERS[kind].read
            data = mutant(chosen(pools[kind], whole[kind], dice), dice)
            path.write_bytes(data)
            end, new = judged(read, path)
            if end in ("read", "refused"):
                ends[f"{kind} {end}"] += 1
                if new not in known[kind] and len(known[kind]) < MOST_GROWN:
                    known[kind].add(new)
                    pools[kind].append(data)
                    if len(corpus(kind)) < options.grow and len(data) < 2000:
                        keep(kind, data)
                continue

            def fails(
                other: bytes,
                end: str = end,
                path: Path = path,
                read: Callable[[Path], object] = read,
            ) -> bool:
                path.write_bytes(other)
                return verdict(read, path).split(":")[0] == end.split(":", maxsplit=1)[0]

            kept = keep(kind, made_small(data, fails))
            failures.append(f"input {number} of seed {options.seed}, kept as {kept}: {end}")
            if len(failures) >= MOST_FAILURES:
                break
    print(", ".join(f"{count} {end}" for end, count in sorted(ends.items())))  # noqa: T201
    if failures:
        sys.exit("\n".join(failures))


if __name__ == "__main__":
    main()
