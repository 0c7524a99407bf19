"""Edits of ``cvtgs convert``."""

import zipfile
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from cvtgs import GaussianScene, load, save
from cvtgs.boxes import Box, Sphere
from cvtgs.cli.main import main
from cvtgs.edit import Motion, concatenate, crop, drop_faint, drop_large, move
from cvtgs.io import losses
from cvtgs.tags import TWO_SCALES
from format_cases import storable_scene
from scenes import random_scene, same_bits


@pytest.fixture
def scene(tmp_path: Path) -> GaussianScene:
    save(random_scene(200, degree=1), tmp_path / "a.ply")
    return load(tmp_path / "a.ply")


def converted(folder: Path, *words: str) -> GaussianScene:
    target = folder / "out.ply"
    command = ["convert", str(folder / "a.ply"), str(target), "--overwrite", *words]
    assert main(command) == 0
    return load(target)


def test_each_edit_equals_that_of_the_api(tmp_path: Path, scene: GaussianScene) -> None:
    box, ball = Box(min=(-1, -1, -1), max=(0, 1, 1)), Sphere(center=(1.0, 0.0, 0.0), radius=0.7)
    regions = ["--crop-box=-1,-1,-1,0,1,1", "--crop-sphere", "1,0,0,0.7"]
    assert same_bits(converted(tmp_path, *regions), crop(scene, [box, ball]))
    assert same_bits(converted(tmp_path, "--min-opacity", "0.3"), drop_faint(scene, 0.3))
    assert same_bits(converted(tmp_path, "--max-size", "0.15"), drop_large(scene, 0.15))
    motion = Motion.of_angles((90, 0, 45), scale=2.0, shift=(1.0, -2.0, 0.5))
    words = ["--rotate", "90,0,45", "--scale", "2", "--translate", "1,-2,0.5"]
    assert same_bits(converted(tmp_path, *words), move(scene, motion))
    assert same_bits(converted(tmp_path), scene)


def test_merge_accepts_several_files_and_formats(tmp_path: Path, scene: GaussianScene) -> None:
    save(random_scene(7, seed=1, degree=2), tmp_path / "b.ply")
    save(random_scene(5, seed=2, degree=0), tmp_path / "c.glb")
    others = [load(tmp_path / "b.ply"), load(tmp_path / "c.glb")]
    names = [str(tmp_path / name) for name in ("b.ply", "c.glb")]
    found = converted(tmp_path, "--merge", names[0], "--merge", names[1])
    assert same_bits(found, concatenate([scene, *others], fill=True))
    assert (len(found), found.sh_degree) == (212, 2)


def test_dropped_gaussians_and_bands_are_printed(
    tmp_path: Path, scene: GaussianScene, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--crop-sphere", "0,0,0,2", "--min-opacity", "0.5", "--sh-degree", "0"]
    found = converted(tmp_path, "--merge", str(tmp_path / "a.ply"), *words)
    inside = crop(
        concatenate([scene, scene], fill=True), [Sphere(center=(0.0, 0.0, 0.0), radius=2.0)]
    )
    printed = " ".join(capsys.readouterr().out.split())
    assert (
        f"Lost: {400 - len(inside)} Gaussians (outside --crop-sphere); "
        f"{len(inside) - len(found)} Gaussians (below --min-opacity); SH bands above degree 0 "
        f"(--sh-degree)."
    ) in printed
    assert 0 < len(found) < len(inside) < 400


def test_edits_use_the_axes_of_a_ply(tmp_path: Path, scene: GaussianScene) -> None:
    save(scene, tmp_path / "turned.ply", axes="rub")
    words = [str(tmp_path / "turned.ply"), str(tmp_path / "out.ply"), "--axes", "rub", "--quiet"]
    assert main(["convert", *words, "--crop-box=-9,0,-9,9,9,9"]) == 0
    assert same_bits(load(tmp_path / "out.ply"), crop(scene, [Box(min=(-9, 0, -9), max=(9, 9, 9))]))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["--crop-box", "1,2,3"],
            "--crop-box must be 6 numbers x,y,z,X,Y,Z, the minimum and max",
        ),
        (
            ["--crop-box", "1,0,0,0,1,1"],
            "min nowhere above max, found min=",
        ),
        (["--crop-sphere", "0,0,0,-1"], "a radius of at least 0"),
        (["--crop-sphere", "0,0,0,0"], "at least one Gaussian must be left to write, found n"),
        (["--min-opacity", "2"], "the lowest opacity to keep must be from 0 to 1, found 2.0."),
        (["--max-size", "0"], "the largest size to keep must be above 0, found 0.0."),
        (["--scale", "-1"], "--scale must be above 0 and finite, found -1.0."),
        (
            ["--scale", "1e-60"],
            "a motion must not shrink all coordinates below 1.18e-38, the",
        ),
        (["--rotate", "90"], "--rotate must be 3 numbers x,y,z, degrees about each axis, fou"),
        (["--rotate", ""], "--rotate must be 3 numbers x,y,z, degrees about each axis, found"),
        (["--translate", ""], "--translate must be 3 numbers x,y,z, found ''"),
        (["--translate", "nan,0,0"], "--translate must be 3 numbers x,y,z, found 'nan,0,0'"),
        (["--merge", "-"], "--merge takes files; only IN may be - for standard input."),
        (["--merge", "missing.ply"], "missing.ply: the file to read must exist, found none."),
        (
            ["--merge", "https://example.org/a.ply"],
            "https:/example.org/a.ply: the file to read must exist, found a web address; download "
            "it first.",
        ),
    ],
)
def test_invalid_edits_write_nothing(
    tmp_path: Path,
    scene: GaussianScene,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    said: str,
) -> None:
    assert len(scene) == 200
    target = tmp_path / "out.ply"
    assert main(["convert", str(tmp_path / "a.ply"), str(target), *words]) == 1
    assert said in capsys.readouterr().err
    assert not target.exists()


def test_older_spz_versions_are_written_on_request(tmp_path: Path, scene: GaussianScene) -> None:
    source, target = tmp_path / "a.ply", tmp_path / "a.spz"
    words = ["convert", str(source), str(target), "--overwrite", "--quiet"]
    starts = {}
    for version in ("2", "3", "4"):
        assert main([*words, "--spz-version", version]) == 0
        starts[version] = target.read_bytes()[:2]
        assert torch.allclose(load(target).means, scene.means, atol=1e-3)
    assert starts == {"2": b"\x1f\x8b", "3": b"\x1f\x8b", "4": b"NG"}


def test_merged_files_of_other_formats_keep_their_axes(tmp_path: Path) -> None:
    scene = storable_scene(200, degree=1)
    save(scene, tmp_path / "a.spz", axes="rub")
    save(scene, tmp_path / "b.spz", axes="rub")
    save(scene, tmp_path / "c.glb")
    words = ["convert", str(tmp_path / "a.spz"), str(tmp_path / "o.ply"), "--axes", "rub"]
    words += ["--merge", str(tmp_path / "b.spz"), "--merge", str(tmp_path / "c.glb")]
    assert main(words) == 0
    found = load(tmp_path / "o.ply")
    for start in (0, 200, 400):
        torch.testing.assert_close(found.means[start : start + 200], scene.means, atol=1e-3, rtol=0)


def test_merging_says_what_is_lost_and_mixed(
    tmp_path: Path, scene: GaussianScene, capsys: pytest.CaptureFixture[str]
) -> None:
    save(replace(scene, comments=("SplatRenderMode: mip",)), tmp_path / "mip.ply")
    save(scene.with_tensors({}, {"label": torch.arange(200)}), tmp_path / "labelled.ply")
    both = ["--merge", str(tmp_path / "mip.ply"), "--merge", str(tmp_path / "labelled.ply")]
    converted(tmp_path, *both)
    printed = capsys.readouterr()
    assert "columns that not all scenes have (label)" in printed.out
    assert "are tagged SplatRenderMode: mip and others are not" in printed.err
    assert "label" not in printed.err
    converted(tmp_path, *both, "--quiet")
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "left out column 'label'" in printed.err


def test_lost_digits_of_moved_positions_are_printed(
    tmp_path: Path, scene: GaussianScene, capsys: pytest.CaptureFixture[str]
) -> None:
    converted(tmp_path, "--translate", "500000,4000000,0")
    printed = " ".join(capsys.readouterr().out.split())
    assert "Lost: digits of positions (steps of 0.25 so far from the origin)." in printed
    converted(tmp_path, "--scale", "1e8")
    assert "Lost: nothing." in capsys.readouterr().out


def test_the_steps_of_a_spz_far_from_the_origin_are_printed(
    tmp_path: Path, scene: GaussianScene, capsys: pytest.CaptureFixture[str]
) -> None:
    """Coordinates of 24 bits are coarser than float32 there, and only their steps are printed."""
    source, target = tmp_path / "in.ply", tmp_path / "far.spz"
    save(scene.with_sh_degree(0), source)
    assert main(["convert", str(source), str(target), "--translate=4500000,0,0"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "Lost: digits of positions (steps of 1 so far from the origin; " in printed
    assert printed.count("digits of positions") == 1
    assert load(target).means[:, 0].unique().numel() < len(scene) / 2
    assert main(["convert", str(source), str(tmp_path / "near.spz")]) == 0
    assert "digits of positions" not in capsys.readouterr().out


def test_quiet_conversions_warn_of_what_edits_lose(
    tmp_path: Path, scene: GaussianScene, capsys: pytest.CaptureFixture[str]
) -> None:
    source, flat = tmp_path / "in.ply", tmp_path / "flat.ply"
    save(scene, source)
    save(replace(scene, comments=(TWO_SCALES.text,)), flat)
    for more, lost in (
        (["--translate=4500000,0,0"], "flat.ply: lost digits of positions (steps of 0."),
        (["--merge", str(source)], "flat.ply: lost the tag '"),
    ):
        words = ["convert", str(flat), str(tmp_path / "out.ply"), *more, "--overwrite", "--quiet"]
        assert main(words) == 0
        printed, warned = capsys.readouterr()
        assert printed == ""
        assert warned.count(lost) == 1


def test_double_precision_far_from_the_origin_is_lost_in_steps() -> None:
    scene = storable_scene(50, degree=0)
    double = scene.with_tensors(**{k: v.double() for k, v in scene.tensors().items()})
    far = double.with_tensors(means=double.means + 4.5e6)
    for suffix, step in ((".glb", "0.5"), (".splat", "0.5"), (".spz", "1")):
        lost = {*losses(far, suffix).dropped} - {*losses(double, suffix).dropped}
        (phrase,) = lost
        assert phrase.startswith(f"digits of positions (steps of {step} so far from the origin; ")
        assert phrase.endswith("; convert --translate moves a scene)")


def test_packed_and_unpacked_sog_have_the_same_axes(tmp_path: Path, scene: GaussianScene) -> None:
    packed, folder = tmp_path / "a.sog", tmp_path / "unpacked"
    save(scene, packed)
    with zipfile.ZipFile(packed) as archive:
        archive.extractall(folder)
    found = []
    for other in (packed, folder / "meta.json"):
        target = tmp_path / f"{other.name}.ply"
        words = ["convert", str(packed), str(target), "--merge", str(other), "--axes", "rub"]
        assert main(words) == 0
        found.append(load(target))
    assert same_bits(*found)
    assert not same_bits(found[0], concatenate([load(packed)] * 2, fill=True))


def test_a_merged_scene_of_which_some_are_flat_loses_the_tag(
    tmp_path: Path, scene: GaussianScene, capsys: pytest.CaptureFixture[str]
) -> None:
    flat = replace(scene, comments=("SplatRenderMode: 2dgs",))
    paths = [tmp_path / "flat.ply", tmp_path / "thick.ply"]
    for one, path in zip((flat, scene), paths, strict=True):
        save(one, path)
    words = ["convert", str(paths[0]), str(tmp_path / "both.ply"), "--merge", str(paths[1])]
    assert main(words) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "Lost: the tag 'SplatRenderMode: 2dgs', since not all scenes have two sc" in printed
