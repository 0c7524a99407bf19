"""Streams in third-party viewers: the PlayCanvas engine and CesiumJS (``nox -s viewers``)."""

from pathlib import Path

import pytest
import torch

import cvtgs
from browser_cases import needs_browser
from cvtgs.streams import stream_file
from viewer_pages import MOST, Pictured, Served, case, least_difference

pytestmark = [needs_browser, pytest.mark.long]


@pytest.mark.filterwarnings("ignore::cvtgs.errors.DroppedDataWarning")
@pytest.mark.parametrize("blocks", [1, 4])
@pytest.mark.parametrize(("page", "kind"), [case("playcanvas", "sog"), case("cesium", "3dtiles")])
def test_streams_look_the_same_in_other_viewers(
    tmp_path: Path, served: Served, pictured: Pictured, page: str, kind: str, blocks: int
) -> None:
    scene, wanted = pictured
    cvtgs.save(scene, tmp_path / "scene.ply")
    report = stream_file(
        tmp_path / "scene.ply", tmp_path / "out", [1.0, 0.25, 0.05], kind=kind, blocks=blocks,
        chunk_gaussians=1024, simplifier=cvtgs.Simplifier(device="cpu"),
    )  # fmt: skip
    assert report.blocks == blocks
    index = {"sog": "lod-meta.json", "3dtiles": "tileset.json"}[kind]
    words = {"type": "gsplat"} if kind == "sog" else {}
    assert least_difference(served, wanted, page, url=f"/files/out/{index}", **words) < MOST


@pytest.mark.filterwarnings("ignore::cvtgs.errors.DroppedDataWarning")
@pytest.mark.parametrize("blocks", [1, 4])
@pytest.mark.parametrize("page", [case("cesium")])
def test_tiles_of_a_survey_look_the_same_millions_of_metres_from_its_origin(
    tmp_path: Path, served: Served, pictured: Pictured, page: str, blocks: int
) -> None:
    scene, wanted = pictured
    shift = (2_683_000.125, -410.5, 1_247_000.75)
    doubles = {name: tensor.double() for name, tensor in scene.tensors().items()}
    doubles["means"] += torch.tensor(shift, dtype=torch.float64)
    cvtgs.save(scene.with_tensors(doubles), tmp_path / "scene.ply")
    stream_file(
        tmp_path / "scene.ply", tmp_path / "out", [1.0, 0.25, 0.05], kind="3dtiles",
        blocks=blocks, chunk_gaussians=1024, simplifier=cvtgs.Simplifier(device="cpu"),
    )  # fmt: skip
    words = {"url": "/files/out/tileset.json", "shift": ",".join(map(str, shift))}
    assert least_difference(served, wanted, page, **words) < MOST
