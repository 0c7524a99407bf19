"""``cvtgs convert``, and formats other than PLY in other commands."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

import cvtgs
from cvtgs import Simplifier, load, save
from cvtgs.cli.main import main
from cvtgs.io import Losses, losses
from format_cases import DATA, WRITABLE, assert_within, storable_scene
from scenes import same_bits

FORMATS = ("ply", "compressed.ply", "spz", "splat", "sog", "glb", "spz.glb")


def test_losses_are_printed_before_writing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, target = DATA / "source.ply", tmp_path / "a.splat"
    assert main(["convert", str(source), str(target)]) == 0
    printed = capsys.readouterr()
    dropped = (
        "SH bands above degree 0 (the scene has degree 3); the tag 'SplatRenderMode: mip', without "
        "which viewers show the scene too sharp"
    )
    assert printed.err == ""
    words = " ".join(printed.out.split())
    assert words.startswith(
        "In files like a.splat: colours and opacities in steps of 1/255 rotations in steps of "
        f"1/128 per component Lost: {dropped}. "
    )
    assert "40 Gaussians of SH degree 0, 11.5 kB -> 1.3 kB" in words
    lines = [line for line in printed.out.splitlines() if line != str(target)]
    assert max(map(len, lines)) <= 80


def test_a_ply_loses_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    source, target = DATA / "source.ply", Path("a.ply")
    monkeypatch.chdir(tmp_path)
    assert main(["convert", str(source), str(target)]) == 0
    assert capsys.readouterr().out == (
        "Lost: nothing.\na.ply: 40 Gaussians of SH degree 3, 11.5 kB -> 11.5 kB\n"
    )
    assert target.read_bytes() == source.read_bytes()


def test_a_comment_that_is_left_out_counts_as_a_loss(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, data = tmp_path / "source.ply", (DATA / "source.ply").read_bytes()
    source.write_bytes(data.replace(b"end_header", b"comment made by hand\nend_header", 1))
    assert main(["convert", str(source), str(tmp_path / "a.spz")]) == 0
    words = " ".join(capsys.readouterr().out.split())
    assert "without 1 comment Lost: nothing else." in words


def test_quiet_prints_only_warnings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["convert", str(DATA / "source.ply"), "--quiet"]
    assert main([*words, str(tmp_path / "a.spz")]) == 0
    assert capsys.readouterr() == ("", "")
    assert main([*words, str(tmp_path / "a.splat")]) == 0
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("cvtgs: warning: ")


def test_outputs_are_replaced_only_with_overwrite(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["convert", str(DATA / "source.ply"), str(tmp_path / "a.sog"), "--quiet"]
    assert [main(words), main(words), main([*words, "--overwrite"])] == [0, 1, 0]
    assert "must not exist yet" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["a.ckpt", "a.xyz"])
def test_unwritable_formats_are_refused_before_reading(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    assert main(["convert", str(tmp_path / "missing.ply"), str(tmp_path / name)]) == 1
    assert f"must end in {WRITABLE}" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("first", FORMATS)
@pytest.mark.parametrize("second", FORMATS)
def test_every_format_converts_to_every_other(tmp_path: Path, first: str, second: str) -> None:
    scene = replace(storable_scene(30, degree=0), comments=())
    save(scene, tmp_path / f"a.{first}")
    words = ["convert", str(tmp_path / f"a.{first}"), str(tmp_path / f"b.{second}"), "--quiet"]
    assert main(words) == 0
    again = load(tmp_path / f"b.{second}")
    assert len(again) == 30
    distances = torch.cdist(scene.means, again.means).amin(dim=1)
    assert float(distances.max()) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("end", FORMATS[1:])
def test_simplify_and_info_accept_every_format(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], end: str
) -> None:
    scene = replace(storable_scene(300, degree=0), comments=())
    save(scene, tmp_path / f"a.{end}")
    words = [str(tmp_path / f"a.{end}"), str(tmp_path / f"b.{end}")]
    assert main(["simplify", *words, "--count", "20", "--ckpt", "none"]) == 0
    assert "300 -> 20 Gaussians" in capsys.readouterr().out
    assert main(["info", words[1]]) == 0
    assert "Gaussians        20" in capsys.readouterr().out


def test_losses_depend_on_the_version_of_a_spz() -> None:
    steps = [losses(storable_scene(3), "a.spz", spz_version=v).changed[2] for v in (2, 3)]
    assert steps == [f"rotations in steps of 1/{count} per component" for count in (127, 723)]


def test_losses_depend_on_the_format() -> None:
    scene = storable_scene(3)
    assert losses(scene, "a.ply") == Losses(dropped=(), changed=(), count=3, sh_degree=3)
    assert losses(scene, "A.SPLAT").sh_degree == 0
    other = replace(scene, comments=("made by hand", "SplatRenderMode: mip"))
    assert losses(other, "a.spz").changed[-1] == "without 1 comment"
    flat = replace(scene, shN=scene.shN[:, :0], extras={})
    for name in ("a.spz", "a.sog", "a.compressed.ply"):
        assert any("view-dependent" in phrase for phrase in losses(scene, name).changed)
        assert not any("view-dependent" in phrase for phrase in losses(flat, name).changed)
        assert not any("SH" in phrase for phrase in losses(flat, name).changed)
    assert losses(other, "a.spz").dropped == ()


def test_axes_apply_to_the_input_and_the_output(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Niantic's file converts to the PLY that it was made from, and back to its own axes."""
    source, small = load(DATA / "source.ply"), tmp_path / "a.spz"
    words = ["convert", str(DATA / "niantic-v3.spz"), "--quiet"]
    assert main([*words, str(tmp_path / "a.ply"), "--axes", "rub"]) == 0
    assert_within(source, load(tmp_path / "a.ply"), {"means": 1e-3, "first_band": 0.04})
    third = ["--spz-version", "3"]
    assert main([*words, str(small), "--axes", "rub:rub", *third]) == 0
    assert main([*words, str(tmp_path / "b.spz"), *third]) == 0
    assert small.read_bytes()[:2] == b"\x1f\x8b"
    assert small.read_bytes() == (tmp_path / "b.spz").read_bytes()
    save(source, tmp_path / "source.ply")
    assert (
        main(["convert", str(tmp_path / "source.ply"), str(tmp_path / "c.spz"), "--axes", ":rub"])
        == 0
    )
    assert_within(source, load(tmp_path / "c.spz", axes="rub"), {"means": 1e-3})
    capsys.readouterr()
    assert main([*words, str(tmp_path / "d.ply"), "--axes", "up"]) == 1
    assert "axes must be the directions of x, y and z" in capsys.readouterr().err


def test_simplify_and_levels_accept_axes(tmp_path: Path) -> None:
    scene = replace(storable_scene(300, degree=1), comments=())
    save(scene, tmp_path / "a.spz", axes="rub")
    words = ["--axes", "rub:luf", "--quiet"]
    size = ["--count", "20", "--ckpt", "none"]
    assert main(["simplify", str(tmp_path / "a.spz"), str(tmp_path / "b.ply"), *size, *words]) == 0
    save(load(tmp_path / "a.spz", axes="rub"), tmp_path / "plain.ply")
    one = ["simplify", str(tmp_path / "plain.ply"), str(tmp_path / "c.ply"), *size, "--quiet"]
    assert main(one) == 0
    assert same_bits(load(tmp_path / "b.ply", axes="luf"), load(tmp_path / "c.ply"))
    two = ["levels", str(tmp_path / "a.spz"), "-o", str(tmp_path / "levels"), "--rho", "0.0667"]
    assert main([*two, *words, "--no-scores", "--ckpt", "none"]) == 0
    (level,) = (tmp_path / "levels").glob("*.ply")
    one = Simplifier(None).levels(load(tmp_path / "plain.ply"), [0.0667])[0]
    assert same_bits(load(level, axes="luf"), one.scene)


@pytest.mark.filterwarnings("ignore::cvtgs.errors.DroppedDataWarning")
@pytest.mark.parametrize("end", FORMATS)
def test_sh_degree_drops_the_bands_above_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], end: str
) -> None:
    source = tmp_path / "a.ply"
    save(replace(storable_scene(300), comments=()), source)
    save(load(source).with_sh_degree(1), tmp_path / f"wanted.{end}")
    words = ["convert", str(source), str(tmp_path / f"b.{end}"), "--sh-degree", "1"]
    assert main(words) == 0
    assert "SH bands above degree 1 (--sh-degree)" in capsys.readouterr().out
    assert (tmp_path / f"b.{end}").read_bytes() == (tmp_path / f"wanted.{end}").read_bytes()
    assert load(tmp_path / f"b.{end}").sh_degree == (0 if end == "splat" else 1)


@pytest.mark.parametrize(("degree", "columns"), [(0, 0), (1, 9), (3, 45)])
def test_simplify_and_levels_write_no_columns_of_dropped_bands(
    tmp_path: Path, degree: int, columns: int
) -> None:
    source, small = tmp_path / "a.ply", tmp_path / "b.ply"
    save(storable_scene(300), source)
    words = ["--ckpt", "none", "--quiet", "--sh-degree", str(degree)]
    assert main(["simplify", str(source), str(small), "--count", "20", *words]) == 0
    levels = ["levels", str(source), "-o", str(tmp_path / "levels"), "--rho", "0.1"]
    assert main([*levels, *words, "--no-scores"]) == 0
    for path in (small, tmp_path / "levels" / "rho_0.1.ply"):
        assert path.read_bytes().count(b"property float f_rest_") == columns
        assert load(path).sh_degree == degree


def test_a_version_of_spz_needs_an_spz(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["convert", str(DATA / "source.ply"), str(tmp_path / "a.glb"), "--spz-version", "4"]
    assert main(words) == 1
    assert "--spz-version needs a .spz to write, found a.glb." in capsys.readouterr().err
    assert not (tmp_path / "a.glb").exists()


@pytest.mark.long
@pytest.mark.parametrize("words", [["--sh-degree", "0"], ["--effects", "sh=0"], []])
def test_a_searched_scene_has_the_columns_of_a_given_count(
    tmp_path: Path, words: list[str]
) -> None:
    source, found, given = (tmp_path / name for name in ("a.ply", "b.ply", "c.ply"))
    save(cvtgs.synthetic.scene("object", 300, sh_degree=1, seed=0), source)
    words = ["--preset", "draft", "--quiet", *words]
    assert main(["simplify", str(source), str(found), "--target-psnr", "12", *words]) == 0
    count = len(load(found))
    assert main(["simplify", str(source), str(given), "--count", str(count), *words]) == 0
    assert found.read_bytes() == given.read_bytes()
