"""Functions that worker processes run in tests; a module, so that they can import them."""

import os
import time

import torch

from cvtgs.errors import InvalidSceneError


def numbered(number: int) -> tuple[int, int, int]:
    return number, os.getpid(), torch.get_num_threads()


def refuse(number: int) -> None:
    raise InvalidSceneError(f"{number}: found none.")


def die(number: int) -> None:
    os._exit(9)


def wait(folder: str, number: int) -> None:
    os.close(os.open(f"{folder}/{os.getpid()}", os.O_CREAT))
    time.sleep(600)
