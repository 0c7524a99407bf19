"""Faults: kills at any moment, two runs at once, full disks, too little memory.

``python tests/faults.py --kills 500 --pairs 100`` (the nox session ``faults``) runs every command
that writes files in forks of this process. It checks that each ends with its status and at most one
sentence, that its files are complete or absent, and that a second run of the command gives the
usual bytes and leaves nothing else in the folder. It prints a line of counts at the end or after
``--seconds``, and stops at the first failure. Needs POSIX.
"""

import argparse
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import torch

import cvtgs
import cvtgs.outofcore
import cvtgs.outofcore.memory
from cvtgs.cli.main import run_process
from fault_commands import CLUSTER, COMMANDS, TRAINING, Command

SIGNALS = {"SIGINT": 130, "SIGTERM": 143, "SIGKILL": -9}
"""Exit status after each signal, by name, since Windows lacks one of them."""

EARLY = 75
"""Exit status of a fork that a signal ends before ``main`` handles signals or writes files."""

BUSY = ("only one run at a time may work on it", "must not exist yet", "must be")


class FaultError(Exception):
    """A command did not end as promised."""


def started(command: Command, folder: Path, *, limit: Callable[[], None] | None = None) -> int:
    """Fork a run of a command; its output goes to a file named after its process."""
    sys.stdout.flush()
    numbers = (signal.SIGINT, signal.SIGTERM)
    signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    process = os.fork()
    for number in numbers if process == 0 else ():
        signal.signal(number, lambda *_: os._exit(EARLY))
    signal.pthread_sigmask(signal.SIG_UNBLOCK, numbers)
    if process:
        return process
    code = 70
    try:
        errors = os.open(
            str(folder.parent / f"errors-{os.getpid()}"), os.O_WRONLY | os.O_CREAT | os.O_TRUNC
        )
        os.dup2(errors, 2)
        os.dup2(errors, 1)
        tempfile.tempdir = os.environ["TMPDIR"] = str(temporary(folder))
        # Optimizers of torch create this folder, by default in that for temporary files.
        os.environ["TORCHINDUCTOR_CACHE_DIR"] = str(folder.parent / "torch")
        if command.blocks:
            cvtgs.outofcore.memory.block_count = lambda *_, **__: command.blocks  # type: ignore[assignment]
        if limit is not None:
            limit()
        places = {"{}": str(folder), "{scheduler}": os.environ.get("FAULTS_SCHEDULER", "")}
        sys.argv = ["cvtgs"]
        for word in command.words:
            for place, found in places.items():
                word = word.replace(place, found)  # noqa: PLW2901
            sys.argv.append(word)
        run_process()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except BaseException:  # the process would print a traceback
        with suppress(MemoryError):
            traceback.print_exc()
    finally:
        with suppress(MemoryError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def ended(process: int, folder: Path) -> tuple[int, str]:
    """Wait for a fork; return its status and its output."""
    code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    path = folder.parent / f"errors-{process}"
    text = path.read_text(errors="replace") if path.exists() else ""
    path.unlink(missing_ok=True)
    if "Traceback" in text or re.search(r"\b\w+Error:", text) or code == 70:
        raise FaultError(f"status {code}: {text[-3000:]}")
    return code, text


def temporary(folder: Path) -> Path:
    """Return the folder for temporary files of a run."""
    path = folder.parent / "temporary"
    path.mkdir(exist_ok=True)
    return path


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def fresh(home: Path) -> Path:
    """Make a folder with the inputs only."""
    folder = home / "work"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for name in ("in.ply", "small.ply", "tiny.toml"):
        shutil.copy(home / name, folder / name)
    shutil.copytree(home / "lessons", folder / "lessons")
    return folder


def same(command: Command, found: dict[str, bytes], wanted: dict[str, bytes]) -> bool:
    """Return whether files are those of an undisturbed run."""
    if found.keys() != wanted.keys():
        return False
    return all(found[name] == wanted[name] or Path(name).name in command.varies for name in wanted)


def check_whole(command: Command, folder: Path, wanted: dict[str, bytes]) -> None:
    """Run the command again, and compare everything in the folder."""
    code, text = ended(started(command, folder), folder)
    found = contents(folder)
    if code or not same(command, found, wanted):
        differs = [name for name in wanted if found.get(name) != wanted[name]]
        more = sorted(found.keys() - wanted.keys())
        raise FaultError(f"the next run: status {code}, differs {differs}, left {more}: {text}")
    if command.leaves_none and (left := [*temporary(folder).iterdir()]):
        raise FaultError(f"temporary files are left: {left}")


def check_part(command: Command, folder: Path, wanted: dict[str, bytes]) -> None:
    """Check that every file under its final name is complete."""
    for name, content in contents(folder).items():
        hidden = any(part.startswith(".") for part in Path(name).parts)
        varies = command.continues or Path(name).name in command.varies
        if not hidden and not varies and content != wanted.get(name):
            raise FaultError(f"{name} is not complete")


def references(home: Path, names: list[str]) -> Iterator[tuple[str, float, dict[str, bytes]]]:
    """Run commands twice without faults; yield their names, durations and files."""
    for name in names:
        command = COMMANDS[name]
        folder = fresh(home)
        start = time.perf_counter()
        code, text = ended(started(command, folder), folder)
        if code:
            raise FaultError(f"{name} does not run: {text}")
        wanted, seconds = contents(folder), time.perf_counter() - start
        check_whole(command, folder, wanted)
        yield name, seconds, wanted


def kill(command: Command, folder: Path, seconds: float, name: str) -> int:
    """Start a command, send a signal after some seconds, and return its status."""
    before = contents(folder)
    process = started(command, folder)
    time.sleep(seconds)
    with suppress(ProcessLookupError):  # it has already ended
        os.kill(process, signal.Signals[name])
    code, text = ended(process, folder)
    if code == EARLY and contents(folder) == before:
        return code
    if code not in (0, SIGNALS[name]) and not (code == 130 and not text):
        raise FaultError(f"status {code} after {name}: {text}")
    sentences = [
        line
        for line in text.splitlines()
        if not line.startswith("cvtgs: warning: ") and " has the finished steps" not in line
    ]
    if len(sentences) > 1:
        raise FaultError(f"more than one sentence after {name}: {text}")
    return code


def starved(share: float) -> Callable[[], None]:
    """Return a function that limits further memory to a share of 512 MiB."""

    def limit() -> None:
        import resource  # noqa: PLC0415 (not on Windows)

        status = Path("/proc/self/status").read_text(encoding="ascii")
        now = 1024 * int(re.search(r"VmSize:\s+(\d+) kB", status)[1])  # type: ignore[index]
        room = now + int(share * (1 << 29))
        resource.setrlimit(resource.RLIMIT_AS, (room, room))

    return limit


def full(share: float) -> Callable[[], None]:
    """Return a function that limits files to a share of 100 kB."""

    def limit() -> None:
        import resource  # noqa: PLC0415

        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(share * 100_000),) * 2)

    return limit


@contextmanager
def cluster(names: list[str]) -> Iterator[None]:
    """Run a Dask cluster of two workers, if a command needs one."""
    if "dask" not in names:
        yield
        return
    place = subprocess.Popen(
        [sys.executable, "-c", CLUSTER],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env={**os.environ, "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "120s"},
    )
    with place:
        os.environ["FAULTS_SCHEDULER"] = place.stdout.readline().strip()  # type: ignore[union-attr]
        yield
        place.communicate()  # closes its input, which ends it


def write_inputs(home: Path, count: int) -> None:
    """Write the inputs of commands: a scene, a small scene, and scenes to train on."""
    scene = cvtgs.synthetic.scene("object", count, sh_degree=1, seed=3)
    cvtgs.save(scene, home / "in.ply")
    cvtgs.save(cvtgs.Simplifier(device="cpu").simplify(scene, 0.1), home / "small.ply")
    (home / "lessons").mkdir()
    for seed, name in enumerate(("exam", "lesson")):
        lesson = cvtgs.synthetic.scene("object", 600, sh_degree=seed, seed=seed)
        cvtgs.save(lesson, home / "lessons" / f"{name}.ply")
    (home / "tiny.toml").write_text(TRAINING, encoding="utf-8")


def main(arguments: list[str] | None = None) -> None:
    """Run all faults, and print the outcomes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=500)
    parser.add_argument("--pairs", type=int, default=100)
    parser.add_argument("--limits", type=int, default=50, help="of memory, and as many of the disk")
    parser.add_argument("--count", type=int, default=6000, help="Gaussians of the scene")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="end after this time")
    parser.add_argument("--commands", nargs="*", choices=[*COMMANDS], default=[*COMMANDS])
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)  # a fork of a process whose OpenMP threads have started can hang
    dice, ends, begun = random.Random(options.seed), Counter[str](), time.monotonic()
    names: list[str] = options.commands
    with tempfile.TemporaryDirectory() as place, cluster(names):
        home = Path(place)
        write_inputs(home, options.count)
        known = {name: (seconds, files) for name, seconds, files in references(home, names)}
        rounds = ["kill"] * options.kills + ["pair"] * options.pairs
        rounds += ["memory", "disk"] * options.limits
        dice.shuffle(rounds)
        for number, kind in enumerate(rounds):
            if time.monotonic() - begun > options.seconds:
                break
            name = dice.choices(names, [COMMANDS[one].rounds for one in names])[0]
            command, (seconds, wanted) = COMMANDS[name], known[name]
            folder = fresh(home)
            if dice.random() < 0.5:  # over the files of an earlier run
                for path, content in wanted.items():
                    (folder / path).parent.mkdir(parents=True, exist_ok=True)
                    (folder / path).write_bytes(content)
            try:
                end = one_fault(kind, command, folder, seconds, wanted, dice)
            except FaultError as error:
                print(counted(ends))  # noqa: T201
                sys.exit(f"round {number} of seed {options.seed}, {kind} of {name}: {error}")
            ends[f"{name} {kind} {end}"] += 1
    print(counted(ends))  # noqa: T201


def counted(ends: Counter[str]) -> str:
    return ", ".join(f"{count} {end}" for end, count in sorted(ends.items()))


def one_fault(
    kind: str,
    command: Command,
    folder: Path,
    seconds: float,
    wanted: dict[str, bytes],
    dice: random.Random,
) -> str:
    """Run one fault, check the files, run the command again; return the exit statuses."""
    if kind == "kill":
        sent = dice.choice([*SIGNALS])
        codes = [kill(command, folder, dice.uniform(0, 1.1 * seconds), sent)]
    elif kind == "pair":
        both = [started(command, folder)]
        time.sleep(dice.uniform(0, seconds))
        both.append(started(command, folder))
        found = [ended(process, folder) for process in both]
        for code, text in found:
            if code not in (0, 1) or (code == 1 and not any(word in text for word in BUSY)):
                raise FaultError(f"status {code} of one of two runs: {text}")
        codes = [code for code, _ in found]
        if 0 not in codes:
            raise FaultError(f"neither of two runs succeeded: {found}")
    else:
        limit = (starved if kind == "memory" else full)(dice.random())
        code, text = ended(started(command, folder, limit=limit), folder)
        lines = [line for line in text.splitlines() if not line.startswith("cvtgs: warning: ")]
        if code not in (0, 1) or len(lines) > 1:
            raise FaultError(f"status {code} under a limit: {text}")
        codes = [code]
    if kind in ("kill", "pair"):
        check_part(command, folder, wanted)
    check_whole(command, folder, wanted)
    return " and ".join(map(str, sorted(codes)))


if __name__ == "__main__":
    main()
