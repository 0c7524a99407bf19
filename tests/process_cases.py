"""Functions that worker processes run in tests, and programs in fresh interpreters."""

import os
import subprocess
import sys
import time

import torch

from cvtgs.errors import DroppedDataWarning, InputError, InvalidSceneError, warn


def numbered(number: int) -> tuple[int, int, int]:
    return number, os.getpid(), torch.get_num_threads()


def refuse(number: int) -> None:
    raise InvalidSceneError(f"{number}: found none.")


def caution(number: int) -> int:
    warn("left out one.", DroppedDataWarning)
    return number


class TwoWordsError(Exception):
    """An error that cannot be unpickled, since it keeps one of two arguments."""

    def __init__(self, one: str, other: str) -> None:
        super().__init__(one)


def fail(number: int) -> None:
    raise TwoWordsError("no", "way")


def miss(number: int) -> None:
    raise InputError(f"{number}: none.").about("a.ply", 2)


def die(number: int) -> None:
    os._exit(9)


def wait(folder: str, number: int) -> None:
    os.close(os.open(f"{folder}/{os.getpid()}", os.O_CREAT))
    time.sleep(600)


def python(program: str, **variables: str) -> list[str]:
    """Run a program in a fresh interpreter; return the lines that it prints."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), **variables}
    result = subprocess.run(
        [sys.executable, "-c", program],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        env=environment,
    )
    return result.stdout.splitlines()
