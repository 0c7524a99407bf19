"""Devices: choice, names, memory and threads."""

import platform
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from cvtgs.devices import (
    HOST,
    check_computes,
    chosen_device,
    chunk_length,
    device_name,
    full_precision,
    in_chunks,
    move_together,
    usable_device,
    within_memory,
)
from cvtgs.errors import DeviceError, OutOfMemoryError, memory_errors
from cvtgs.rendering import choose_backend
from pretended_device import pretended_cuda


def test_a_named_device_is_used_as_given():
    assert chosen_device("cpu", "meta") == usable_device("cpu") == torch.device("cpu")


def test_nothing_is_computed_without_values():
    with pytest.raises(DeviceError, match=r"^device 'meta' cannot be used here: its tensors have"):
        chosen_device("meta")


def test_tensors_of_any_dtype_and_shape_move_in_one_copy():
    tensors = [
        torch.arange(12, dtype=torch.float64).view(3, 4).T,
        torch.tensor([True, False, True]),
        torch.tensor(7),
        torch.empty(0, 3),
        torch.linspace(0, 1, 33, dtype=torch.float32),
        torch.arange(6).view(3, 2)[:, 1:],
    ]
    with pretended_cuda() as traffic:
        there = move_together(tensors, torch.device("cuda"))
        assert traffic.copies.total() == 1
        back = move_together(there, HOST)
        assert traffic.copies.total() == 2
    for before, after in zip(tensors, back, strict=True):
        assert before.dtype == after.dtype
        assert torch.equal(before, after)


def test_tensors_that_are_there_do_not_move():
    tensors = [torch.ones(2), torch.zeros(3)]
    assert all(a is b for a, b in zip(tensors, move_together(tensors, HOST), strict=True))


@pytest.mark.parametrize(
    ("has_cuda", "home", "found"),
    [
        (False, "cpu", "cpu"),
        (True, "cpu", "cuda:3"),
        (True, "meta", "meta"),
        (False, "meta", "meta"),
    ],
)
def test_auto_is_cuda_for_data_on_the_cpu(monkeypatch, has_cuda, home, found):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: has_cuda)
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: has_cuda)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 3)
    assert chosen_device("auto", home) == torch.device(found)


@pytest.mark.parametrize(("gigabytes", "factor"), [(0.1, 1), (2, 4), (8, 16), (80, 128)])
def test_chunks_are_longer_where_launches_are_expensive(monkeypatch, gigabytes, factor):
    found = SimpleNamespace(total_memory=int(gigabytes * 2**30))
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: found)
    assert chunk_length(7, torch.device("cpu")) == 7
    assert chunk_length(7, torch.device("meta")) == 896
    assert chunk_length(7, torch.device("cuda")) == 7 * factor


def test_devices_without_float64_are_not_computed_on(monkeypatch):
    def empty(*size, dtype=None, device=None):
        if dtype == torch.float64 and torch.device(device).type in ("meta", "mps"):
            raise TypeError("Cannot convert a MPS Tensor to float64 dtype")
        return original(*size, dtype=dtype, device=device)

    original = torch.empty
    monkeypatch.setattr(torch, "empty", empty)
    assert chosen_device("auto", "meta") == torch.device("cpu")
    assert chosen_device("cpu") == torch.device("cpu")
    with pytest.raises(DeviceError, match=r"'meta' cannot be used here: its tensors have no"):
        check_computes(torch.device("meta"))
    with pytest.raises(DeviceError, match=r"'mps' cannot be used here: it has no float64"):
        check_computes(torch.device("mps"))


def test_images_that_do_not_fit_lead_to_the_cpu_as_well():
    def compute(device: torch.device, note: str) -> str:
        with memory_errors("rendering", "render fewer"):
            if device.type != "cpu":
                raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB")
        return note

    note = within_memory(compute, torch.device("meta"), work="a test", may_leave=True)
    assert note == "meta ran out of memory; computed on the CPU"


def test_a_full_host_leads_nowhere():
    tried = []

    def compute(device: torch.device, note: str) -> None:
        tried.append(device)
        with memory_errors("rendering", "render fewer"):
            raise MemoryError

    with pytest.raises(OutOfMemoryError, match="rendering needs more memory"):
        within_memory(compute, torch.device("meta"), work="a test", may_leave=True)
    assert len(tried) == 1


def test_images_need_a_device_with_float64():
    with pytest.raises(DeviceError, match=r"^device 'mps' cannot be used here: it has no float64"):
        choose_backend("torch", torch.device("mps"))


@pytest.mark.parametrize("may_leave", [True, False])
@pytest.mark.slow
def test_running_out_of_memory_leads_to_short_chunks_then_the_cpu(may_leave):
    tried = []

    def compute(device: torch.device, note: str) -> str:
        tried.append((str(device), chunk_length(1, device), note))
        if device.type != "cpu":
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB")
        return note

    there = torch.device("meta")
    if may_leave:
        note = within_memory(compute, there, work="a test", may_leave=True)
        assert note == "meta ran out of memory; computed on the CPU"
    else:
        with pytest.raises(OutOfMemoryError, match="a test needs more memory than meta has"):
            within_memory(compute, there, work="a test", may_leave=False)
    assert tried[:2] == [
        ("meta", 128, ""),
        ("meta", 1, "meta ran out of memory; computed there in short chunks"),
    ]
    assert chunk_length(1, there) == 128
    assert len(tried) == 2 + may_leave


@pytest.mark.parametrize("where", ["cpu", "meta"])
def test_other_errors_are_raised_at_once(where):
    tried = []

    def compute(device: torch.device, note: str) -> None:
        tried.append(device)
        raise RuntimeError("out of memory" if where == "cpu" else "shapes differ")

    with pytest.raises(RuntimeError):
        within_memory(compute, torch.device(where), work="a test", may_leave=True)
    assert len(tried) == 1


@pytest.mark.parametrize("name", ["tpu9", "cpu:seven"])
def test_a_missing_device_is_an_error(name):
    for choose in (usable_device, chosen_device):
        with pytest.raises(DeviceError, match=f"device '{name}' cannot be used here: "):
            choose(name)


def test_names_of_devices(monkeypatch):
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "some GPU")
    assert device_name(torch.device("cuda")) == "some GPU"
    assert device_name(torch.device("meta")) == "meta"

    def refuse(*args, **more):
        raise FileNotFoundError

    monkeypatch.setattr(Path, "read_text", refuse)
    assert device_name(torch.device("cpu")) == (platform.processor() or platform.machine())


@pytest.mark.usefixtures("two_threads")
def test_threads_take_tensors_of_inference_mode():
    """They were made in the thread of the caller."""
    with torch.inference_mode():
        sums = torch.zeros(8)

        def add(part: slice) -> None:
            sums[part] += 1.0

        in_chunks(add, 8, 2, torch.device("cpu"))
    assert bool((sums == 1).all())


def test_fewer_bits_of_matrix_products_are_not_used():
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium")
    try:
        with full_precision():
            assert torch.get_float32_matmul_precision() == "highest"
        assert torch.get_float32_matmul_precision() == "medium"
    finally:
        torch.set_float32_matmul_precision(before)


def test_fewer_bits_are_not_used_while_any_thread_needs_them_all():
    """The setting is that of the whole process; calls overlap, and the first one ends first."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high")
    try:
        with ThreadPoolExecutor(1) as pool, ExitStack() as first, ExitStack() as second:
            first.enter_context(full_precision())
            pool.submit(second.enter_context, full_precision()).result()
            first.close()
            assert torch.get_float32_matmul_precision() == "highest"
        assert torch.get_float32_matmul_precision() == "high"
    finally:
        torch.set_float32_matmul_precision(before)


@pytest.mark.skipif(
    not hasattr(torch.backends.cuda.matmul, "fp32_precision"), reason="needs torch 2.9"
)
@pytest.mark.parametrize("kind", ["cuda", "mkldnn"])
def test_fewer_bits_by_the_newer_setting_are_not_used_either(kind):
    matmul = getattr(torch.backends, kind).matmul
    before = matmul.fp32_precision
    matmul.fp32_precision = "bf16" if kind == "mkldnn" else "tf32"
    try:
        chosen = matmul.fp32_precision
        with full_precision():
            assert matmul.fp32_precision == "ieee"
        assert matmul.fp32_precision == chosen
    finally:
        matmul.fp32_precision = before
