"""``.splat`` files."""

import math
import struct
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings, strategies as st

from cvtgs import GaussianScene, load, save
from cvtgs.errors import DroppedDataWarning, FileFormatError, InvalidSceneError
from format_cases import DATA, assert_as_oracle, assert_within, nearest_rows, storable_scene
from format_oracles import read_splat

BOUNDS = {
    "means": 0.0,
    "log_scales": 1e-6,
    "opacities": 0.5 / 255 + 1e-6,
    "sh0": 0.5 / 255 / 0.2820948 + 1e-6,
    "angle": 0.02,
}


def test_a_row_made_by_hand_is_read(tmp_path: Path) -> None:
    """At (1, 2, 3), with scales 1, 2, e, red, opacity 51 / 255, a half turn about x."""
    path = tmp_path / "a.splat"
    path.write_bytes(struct.pack("<6f8B", 1, 2, 3, 1, 2, math.e, 255, 0, 0, 51, 128, 255, 128, 128))
    scene = load(path)
    assert repr(scene) == "GaussianScene(1 Gaussian, SH degree 0, float32, cpu)"
    assert scene.means.tolist() == [[1, 2, 3]]
    torch.testing.assert_close(scene.log_scales, torch.tensor([[0, math.log(2), 1]]))
    torch.testing.assert_close(scene.opacities, torch.tensor([0.2]))
    red = 0.5 / 0.28209479
    torch.testing.assert_close(scene.sh0, torch.tensor([[[red, -red, -red]]]))
    assert scene.quats.tolist() == [[0, 1, 0, 0]]
    assert scene.comments == ()


def test_the_written_bytes_are_as_computed_by_hand(tmp_path: Path) -> None:
    scene = GaussianScene(
        means=torch.tensor([[1.0, 2.0, 3.0]]),
        quats=torch.tensor([[0.0, -3.0, 0.0, 4.0]]),  # 128 - 0.6 * 128 = 51.2
        log_scales=torch.tensor([[0.0, 0.0, 0.0]]),
        logit_opacities=torch.tensor([float("inf")]),
        sh0=torch.zeros(1, 1, 3),
        shN=torch.zeros(1, 0, 3),
    )
    save(scene, tmp_path / "a.splat")
    assert (tmp_path / "a.splat").read_bytes() == struct.pack(
        "<6f8B", 1, 2, 3, 1, 1, 1, 128, 128, 128, 255, 128, 51, 128, 230
    )


def test_a_file_of_the_antimatter15_viewer_is_read() -> None:
    path = DATA / "antimatter15.splat"
    scene = load(path)
    assert_as_oracle(scene, read_splat(path.read_bytes()))
    # Its writer truncates instead of rounding, so errors are up to a whole step.
    bounds = {name: 2 * bound for name, bound in BOUNDS.items() if name != "means"}
    source = load(DATA / "source.ply")
    assert_within(source, nearest_rows(source, scene), bounds)


@settings(max_examples=20, deadline=None)
@given(count=st.integers(1, 40), seed=st.integers(0, 1000))
def test_round_trip(tmp_path_factory: pytest.TempPathFactory, count: int, seed: int) -> None:
    path = tmp_path_factory.mktemp("splat") / "a.splat"
    scene = storable_scene(count, seed=seed, degree=0)
    with pytest.warns(DroppedDataWarning, match="mip"):
        save(scene, path)
    again = load(path)
    assert_within(scene, again, BOUNDS)
    assert_as_oracle(again, read_splat(path.read_bytes()))
    assert path.stat().st_size == 32 * count


def test_dropped_data_is_warned_about_in_full(tmp_path: Path) -> None:
    scene = storable_scene(4, degree=2)
    scene = scene.with_tensors({"sh0": 9 * scene.sh0.sign()}, {"label": torch.arange(4)})
    scene = scene.with_tensors(
        {name: tensor.double() for name, tensor in scene.tensors().items()}, scene.extras
    )
    means = scene.means.clone()
    means[1, 0] = float("nan")
    scene = scene.with_tensors({"means": means}, scene.extras)
    path = tmp_path / "a.splat"
    with pytest.warns(DroppedDataWarning) as caught:
        save(scene, path)
    assert [str(one.message) for one in caught] == [
        f"{path}: files of this format do not hold extra column 'label'; SH bands above degree 0 "
        f"(the scene has degree 2); the tag 'SplatRenderMode: mip', without which viewers show the "
        f"scene too sharp; double precision; 1 Gaussian that is not finite or has no rotation; "
        f"colours (SH band 0) outside [-1.7794, 1.7794], which are clamped (3 Gaussians)."
    ]
    assert caught[0].filename == __file__
    assert len(load(path)) == 3


@pytest.mark.filterwarnings("error")
def test_a_warning_that_is_an_error_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(DroppedDataWarning):
        save(storable_scene(4, degree=1), tmp_path / "a.splat")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("size", [0, 31, 33])
def test_a_file_with_a_partial_gaussian_is_refused(tmp_path: Path, size: int) -> None:
    path = tmp_path / "a.splat"
    path.write_bytes(bytes(size))
    with pytest.raises(FileFormatError) as caught:
        load(path)
    assert str(caught.value) == (
        f"{path}: a .splat file must hold one or more Gaussians of 32 bytes each and no header, "
        f"found {size} bytes that start with {path.read_bytes()[:4]!r}."
    )


def test_a_ply_with_the_wrong_suffix_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.splat"
    path.write_bytes(b"ply\n".ljust(64))
    with pytest.raises(
        FileFormatError, match=r"and no header, found 64 bytes that start with b'ply\\n'"
    ):
        load(path)


def test_a_web_page_in_place_of_the_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.splat"
    path.write_bytes(b"<!DOCTYPE html><p>Not found".ljust(64))
    with pytest.raises(FileFormatError, match="no header, found 64 bytes that start with b'<!DO'"):
        load(path)


def test_rows_of_zeros_are_read_as_small_faint_gaussians(tmp_path: Path) -> None:
    path = tmp_path / "a.splat"
    path.write_bytes(bytes(32))
    scene = load(path)
    assert scene.log_scales.isfinite().all()
    torch.testing.assert_close(scene.quats, torch.full((1, 4), -0.5))
    assert float(scene.opacities) < 2e-6


def test_a_scene_without_finite_gaussians_is_not_written(tmp_path: Path) -> None:
    scene = storable_scene(2, degree=0)
    scene = scene.with_tensors({"means": scene.means * float("nan")}, {})
    with pytest.warns(DroppedDataWarning), pytest.raises(InvalidSceneError) as caught:
        save(scene, tmp_path / "a.splat")
    assert str(caught.value) == (
        "a scene to write must hold a Gaussian with finite values, found 0 of 2."
    )
    assert list(tmp_path.iterdir()) == []
