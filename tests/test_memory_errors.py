"""Out-of-memory errors of every library become one sentence that says what to do."""

import errno
from pathlib import Path

import pytest
import torch

import cvtgs
from cvtgs import io
from cvtgs.cli.main import main
from cvtgs.errors import FileFormatError, OutOfMemoryError, is_out_of_memory, memory_errors
from scenes import random_scene


def torch_error() -> RuntimeError:
    """Return the error that torch really raises."""
    try:
        torch.empty(1 << 60, dtype=torch.uint8)
    except RuntimeError as error:
        return error
    raise AssertionError


def with_number(error: OSError, winerror: int) -> OSError:
    error.winerror = winerror  # type: ignore[attr-defined,unused-ignore]  # that of Windows
    return error


NO_MEMORY = {
    "python": MemoryError(),
    "torch": torch_error(),
    "torch on Windows": RuntimeError("DefaultCPUAllocator: not enough memory: you tried to"),
    "cuda": torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB"),
    "cuda kernel": RuntimeError("CUDA error: out of memory"),
    "cublas": RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling"),
    "c++": RuntimeError("std::bad_alloc"),
    "system": OSError(errno.ENOMEM, "Cannot allocate memory"),
    "loader": ImportError("libtorch.so: failed to map segment from shared object"),
    "threads": RuntimeError("can't start new thread"),
    "loader on Windows": ImportError("DLL load failed: The paging file is too small for this"),
    "mapping on Windows": RuntimeError("Couldn't open file mapping: <a>, error code: <1455>"),
    "system on Windows, translated": with_number(OSError(22, "Die Auslagerungsdatei ist zu"), 1455),
}


@pytest.mark.parametrize("name", NO_MEMORY)
def test_known_memory_errors_are_recognised(name: str) -> None:
    assert is_out_of_memory(NO_MEMORY[name])
    with pytest.raises(OutOfMemoryError) as caught, memory_errors("the work", "rest"):
        raise NO_MEMORY[name]
    assert str(caught.value) == "the work needs more memory than is available; rest."


@pytest.mark.parametrize(
    "error", [RuntimeError("shapes differ"), KeyError("out of memory"), ValueError(), OSError()]
)
def test_other_errors_are_not_changed(error: Exception) -> None:
    assert not is_out_of_memory(error)
    with pytest.raises(type(error)), memory_errors("the work", "rest"):
        raise error


def test_causes_are_recognised_and_errors_are_not_wrapped_twice() -> None:
    outer, inner = memory_errors("two", "rest"), memory_errors("one", "rest")
    with pytest.raises(OutOfMemoryError, match="one needs"), outer, inner:
        raise MemoryError
    with pytest.raises(OutOfMemoryError, match="two needs"), memory_errors("two", "rest"):
        raise FileFormatError("damaged.") from MemoryError()
    with pytest.raises(FileFormatError), memory_errors("two", "rest"):
        raise FileFormatError("damaged.") from ValueError()


def without_memory(*_: object, **__: object) -> None:
    torch.empty(1 << 60, dtype=torch.uint8)


@pytest.mark.parametrize("reader", ["ply:read_ply", "splat:read_splat"])
def test_memory_errors_while_loading(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reader: str
) -> None:
    module, name = reader.split(":")
    path = tmp_path / f"a.{module}"
    io.save(random_scene(2, degree=0), path)
    monkeypatch.setattr(f"cvtgs.io.{module}.{name}", without_memory)
    with pytest.raises(OutOfMemoryError) as caught:
        io.load(path)
    assert str(caught.value) == (
        f"{path}: reading the scene needs more memory than is available; free some, or simplify "
        f"a binary .ply block by block: cvtgs simplify IN OUT --memory AMOUNT."
    )
    assert isinstance(caught.value, MemoryError)


def test_memory_errors_of_simplification_and_writing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, path = random_scene(50), tmp_path / "a.splat"
    monkeypatch.setattr("cvtgs.prepared.reduce_scene", without_memory)
    with pytest.raises(OutOfMemoryError) as caught:
        cvtgs.Simplifier(device="cpu").simplify(scene, 0.5)
    assert str(caught.value) == (
        "simplifying 50 Gaussians needs more memory than is available; free some, or simplify a "
        "binary .ply block by block: cvtgs simplify IN OUT --memory AMOUNT."
    )
    monkeypatch.setattr("cvtgs.io.splat.write_splat", without_memory)
    with pytest.raises(OutOfMemoryError, match=r"writing .* needs more memory .*; free some"):
        io.save(random_scene(5, degree=0), path)
    assert not path.exists()


def test_memory_errors_at_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.ply"
    io.save(random_scene(50), path)
    monkeypatch.setattr(cvtgs.Simplifier, "run", without_memory)
    words = ["simplify", str(path), str(tmp_path / "b.ply"), "--rho", "0.5", "--quiet"]
    assert main([*words, "--preset", "fast"]) == 1
    assert capsys.readouterr().err == (
        "cvtgs: error: cvtgs simplify needs more memory than is available; free some, or process a "
        "binary .ply in blocks with --memory AMOUNT, for example 2GB, and use --device cpu if a "
        "GPU ran out.\n"
    )
    assert not (tmp_path / "b.ply").exists()


def test_only_commands_that_have_blocks_advise_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("cvtgs.synthetic.demo_scene", without_memory)
    assert main(["demo", "-o", str(tmp_path / "out"), "--quiet"]) == 1
    assert capsys.readouterr().err == (
        "cvtgs: error: cvtgs demo needs more memory than is available; free some, or ask for less, "
        "and use --device cpu if a GPU ran out.\n"
    )


def test_too_little_memory_for_torch(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def load() -> None:
        raise NO_MEMORY["loader"]

    monkeypatch.setattr("cvtgs.cli.main.load_torch", load)
    assert main(["info", "a.ply"]) == 1
    assert capsys.readouterr().err.startswith("cvtgs: error: cvtgs info needs more memory than is")
