"""Devices: which one is chosen, and what it is called."""

import platform
from pathlib import Path

import pytest
import torch

from cvtgs.devices import (
    chosen_device,
    chunk_length,
    device_name,
    one_thread,
    resolve_device,
    usable_device,
)
from cvtgs.errors import DeviceError


def test_a_name_is_taken_at_its_word():
    assert chosen_device("cpu", "meta") == usable_device("cpu") == torch.device("cpu")


@pytest.mark.parametrize(
    ("has_cuda", "home", "found"),
    [(False, "cpu", "cpu"), (True, "cpu", "cuda"), (True, "meta", "meta"), (False, "meta", "meta")],
)
def test_auto_is_cuda_for_what_is_on_the_cpu(monkeypatch, has_cuda, home, found):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: has_cuda)
    assert resolve_device("auto") is None
    assert chosen_device("auto", home) == torch.device(found)


def test_chunks_are_longer_where_launches_cost():
    assert chunk_length(7, torch.device("cpu")) == 7
    assert chunk_length(7, torch.device("cuda")) == 224


@pytest.mark.parametrize("name", ["tpu9", "cpu:seven"])
def test_a_device_that_is_not_there(name):
    for choose in (usable_device, resolve_device, chosen_device):
        with pytest.raises(DeviceError, match=f"device '{name}' cannot be used here: "):
            choose(name)


def test_names(monkeypatch):
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "some GPU")
    assert device_name(torch.device("cuda")) == "some GPU"
    assert device_name(torch.device("meta")) == "meta"

    def refuse(*args, **more):
        raise FileNotFoundError

    monkeypatch.setattr(Path, "read_text", refuse)
    assert device_name(torch.device("cpu")) == (platform.processor() or platform.machine())


def test_threads_come_back_after_an_error():
    before = torch.get_num_threads()
    with pytest.raises(ZeroDivisionError), one_thread():
        divmod(torch.get_num_threads(), 0)
    assert torch.get_num_threads() == before
