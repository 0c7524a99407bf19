"""``cvtgs levels --stream``."""

from pathlib import Path

import pytest

from cvtgs import load, save
from cvtgs.cli.main import main
from scenes import random_scene


@pytest.fixture
def words(tmp_path: Path) -> list[str]:
    save(random_scene(2000, degree=0), tmp_path / "a.ply")
    folder = str(tmp_path / "out")
    return ["levels", str(tmp_path / "a.ply"), "-o", folder, "--ckpt", "none", "--preset", "draft"]


@pytest.mark.parametrize("kind", ["sog", "3dtiles"])
def test_a_stream(
    tmp_path: Path, words: list[str], kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*words, "--stream", kind, "--chunk", "300", "--rho", "1,0.1,0.01"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("a.ply in ")
    assert lines[2].split()[0] == "2,000"
    if kind == "sog":
        counts = [len(load(tmp_path / "out", lod=lod)) for lod in range(3)]
        assert counts == [2000, 200, 20]
    else:
        assert len(load(tmp_path / "out" / "0.glb")) == 20


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--stream", "sog", "--suffix", ".spz"], "--suffix cannot go with --stream"),
        (["--chunk", "300"], "--chunk goes with --stream."),
        (["--stream", "sog", "--chunk", "0"], "--chunk must be at least 1, found 0."),
    ],
)
def test_options_that_do_not_fit(
    tmp_path: Path,
    words: list[str],
    more: list[str],
    said: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main([*words, *more]) == 1
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
