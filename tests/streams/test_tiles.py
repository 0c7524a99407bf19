"""Where 3D Tiles put Gaussians: transforms of tiles, far origins, and places on the Earth."""

import json
import math
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch
from torch import Tensor

from cvtgs import GaussianScene, Simplifier, concatenate, load, save
from cvtgs.errors import DroppedDataWarning
from cvtgs.streams import geo_transform, plan_stream, stream_file, write_tiles
from cvtgs.streams.tiles import TilesFormat
from cvtgs.synthetic import scene as make

SURVEY = torch.tensor([2_683_000.125, -410.5, 1_247_000.75], dtype=torch.float64)
FAST = Simplifier(None, preset="draft", device="cpu")


def inside_of(folder: Path, tile: dict[str, Any]) -> Tensor:
    """Return the positions of a tile, relative to its origin, in the axes of 3D Tiles.

    Viewers turn glTF from y up to z up: (x, y, z) to (x, -z, y).
    """
    x, y, z = load(folder / tile["content"]["uri"], axes="rdf").means.double().unbind(1)
    return torch.stack([x, -z, y], dim=1)


def placed(folder: Path) -> Iterator[tuple[dict[str, Any], Tensor]]:
    """Yield every tile with content, and its positions where a viewer draws them."""

    def below(tile: dict[str, Any], above: Tensor) -> Iterator[tuple[dict[str, Any], Tensor]]:
        matrix = above @ torch.tensor(tile["transform"], dtype=torch.float64).reshape(4, 4).T
        if "content" in tile:
            yield tile, inside_of(folder, tile) @ matrix[:3, :3].T + matrix[:3, 3]
        for child in tile.get("children", ()):
            yield from below(child, matrix)

    root = json.loads((folder / "tileset.json").read_text())["root"]
    yield from below(root, torch.eye(4, dtype=torch.float64))


def test_flyaways_are_clamped_without_warnings_of_numpy(tmp_path: Path) -> None:
    scene = make("object", 3000, sh_degree=1, seed=0)
    means = scene.means.clone()
    means[0] = 1e38
    levels = FAST.levels(scene.with_tensors(means=means), [1.0, 0.5])
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        warnings.simplefilter("ignore", DroppedDataWarning)
        write_tiles(plan_stream(levels), tmp_path / "tiles")


def in_tile_axes(scene: GaussianScene) -> Tensor:
    """Return positions with x left, y back and z up in the scene."""
    x, y, z = scene.means.double().unbind(1)
    return torch.stack([-x, -z, -y], dim=1)


def surveyed() -> GaussianScene:
    """Return a scene in doubles, millions of units from its origin."""
    scene = make("object", 3000, sh_degree=0, seed=2)
    doubles = {name: tensor.double() for name, tensor in scene.tensors().items()}
    return scene.with_tensors({**doubles, "means": doubles["means"] + SURVEY})


def assert_finest_is(scene: GaussianScene, folder: Path, *, digits: float) -> None:
    finest = [points for tile, points in placed(folder) if "children" not in tile]
    apart = torch.cdist(torch.cat(finest) - finest[0][0], in_tile_axes(scene) - finest[0][0])
    assert len(apart) == len(scene)
    assert float(apart.amin(dim=0).max()) < digits
    assert float(apart.amin(dim=1).max()) < digits


@pytest.mark.filterwarnings("error")
def test_far_from_the_origin_positions_keep_their_digits(tmp_path: Path) -> None:
    scene = surveyed()
    levels = FAST.levels(scene, [1.0, 0.05])
    write_tiles(plan_stream(levels, chunk_gaussians=300), tmp_path, tile_gaussians=500)
    assert len(list(placed(tmp_path))) > 4
    assert_finest_is(scene, tmp_path, digits=3e-4)


@pytest.mark.filterwarnings("error")
@pytest.mark.slow
def test_blocks_keep_them_too(tmp_path: Path) -> None:
    scene = surveyed()
    save(scene, tmp_path / "survey.ply")
    options: dict[str, Any] = {"kind": "3dtiles", "blocks": 3, "simplifier": FAST}
    stream_file(tmp_path / "survey.ply", tmp_path / "out", [1.0, 0.05], **options)
    root = json.loads((tmp_path / "out" / "tileset.json").read_text())["root"]
    assert "content" not in root
    assert_finest_is(scene, tmp_path / "out", digits=3e-4)


def test_one_far_gaussian_does_not_cost_the_others_digits(tmp_path: Path) -> None:
    scene = make("object", 3000, sh_degree=0, seed=2)
    means = scene.means.clone()
    means[0] = torch.tensor([1e6, 0.0, 0.0])
    levels = FAST.levels(scene.with_tensors({"means": means}), [1.0])
    with pytest.warns(UserWarning, match="clamped"):
        write_tiles(plan_stream(levels), tmp_path)
    ((_, points),) = placed(tmp_path)
    near = in_tile_axes(levels[0].scene)[1:]
    assert float(torch.cdist(near, points).amin(dim=1).max()) < 3e-4


def write(
    scene: GaussianScene,
    folder: Path,
    rhos: list[float],
    *,
    blocks: int | None,
    chunk_gaussians: int,
) -> None:
    """Write 3D Tiles to ``folder / "out"``, in one piece without a number of blocks."""
    if blocks is None:
        plan = plan_stream(FAST.levels(scene, rhos), chunk_gaussians=chunk_gaussians)
        write_tiles(plan, folder / "out")
        return
    save(scene, folder / "scene.ply")
    options: dict[str, Any] = {"blocks": blocks, "chunk_gaussians": chunk_gaussians}
    out = folder / "out"
    stream_file(folder / "scene.ply", out, rhos, kind="3dtiles", simplifier=FAST, **options)


@pytest.mark.parametrize("blocks", [None, 2])
def test_boxes_enclose_flyaways_where_files_hold_them(blocks: int | None, tmp_path: Path) -> None:
    """Not where they were; so the error of the whole tileset stays small, too."""
    scene = make("object", 6000, sh_degree=0, seed=2)
    means, log_scales = scene.means.clone(), scene.log_scales.clone()
    means[0] = torch.tensor([1e6, 0.0, 0.0])
    log_scales[1] = 20.0
    flying = scene.with_tensors({"means": means, "log_scales": log_scales})
    with pytest.warns(DroppedDataWarning, match="clamped"):
        write(flying, tmp_path, [1.0, 0.05], blocks=blocks, chunk_gaussians=10_000)
    farthest = 0.0
    for tile, _ in placed(tmp_path / "out"):
        points, box = inside_of(tmp_path / "out", tile), tile["boundingVolume"]["box"]
        half = torch.tensor([box[3], box[7], box[11]], dtype=torch.float64)
        assert ((points - torch.tensor(box[:3], dtype=torch.float64)).abs() <= half).all()
        assert float(half.max()) < 5000
        farthest = max(farthest, float(points.abs().max()))
    assert farthest > 500
    document = json.loads((tmp_path / "out" / "tileset.json").read_text())
    assert document["geometricError"] < 20_000


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::cvtgs.errors.DroppedDataWarning")
@pytest.mark.parametrize("blocks", [None, 2])
def test_tiles_of_an_object_have_smaller_errors_than_those_of_a_sky(
    blocks: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All tiles of a level had the same one, also within a block."""
    near = make("object", 3000, sh_degree=0, seed=2)
    far = make("object", 1000, sh_degree=0, seed=3)
    scene = concatenate([near, far.with_tensors({"means": 100 * far.means})])
    few = TilesFormat(tile_gaussians=150)
    monkeypatch.setattr("cvtgs.streams.tiles.TilesFormat", lambda **_: few)
    monkeypatch.setattr("cvtgs.streams.blocks.TilesFormat", lambda **_: few)
    write(scene, tmp_path, [1.0, 0.25, 0.01], blocks=blocks, chunk_gaussians=300)
    errors = [
        tile["geometricError"]
        for tile, _ in placed(tmp_path / "out")
        if tile["content"]["uri"].startswith("0_")
        and tile.get("children")
        and not any("children" in child for child in tile["children"])
    ]
    assert len(errors) > 3
    assert max(errors) > 10 * min(errors)


def test_the_scene_points_right_to_the_east_and_forward_to_the_north(tmp_path: Path) -> None:
    """At 90 degrees east on the equator, east is -x, north is z, and up is y."""
    scene = make("object", 500, sh_degree=0, seed=2)
    offset = torch.tensor([100.0, -7.0, 30.0])  # right, down, forward
    (level,) = FAST.levels(scene.with_tensors({"means": scene.means + offset}), [1.0])
    write_tiles(plan_stream([level]), tmp_path, transform=geo_transform(90.0, 0.0, 5.0))
    ((_, points),) = placed(tmp_path)
    middle = scene.means.double().mean(dim=0) + offset
    x, y, z = points.mean(dim=0).tolist()
    assert x == pytest.approx(-float(middle[0]), abs=1e-3)
    assert y == pytest.approx(6378137.0 + 5.0 - float(middle[1]), abs=1e-3)
    assert z == pytest.approx(float(middle[2]), abs=1e-3)


def test_the_transform_of_a_place_on_earth() -> None:
    """At 90 degrees east on the equator, west is x, south is -z, and up is y."""
    matrix = torch.tensor(geo_transform(90.0, 0.0, 100.0), dtype=torch.float64).reshape(4, 4).T
    wanted = [[1, 0, 0, 0], [0, 0, 1, 6378237], [0, -1, 0, 0], [0, 0, 0, 1]]
    torch.testing.assert_close(matrix, torch.tensor(wanted, dtype=torch.float64))
    for place in ((8.5, 47.4), (-120.0, -33.0)):
        turn = torch.tensor(geo_transform(*place), dtype=torch.float64).reshape(4, 4)[:3, :3]
        assert float(torch.linalg.det(turn)) == pytest.approx(1.0)  # not mirrored
    pole = geo_transform(0.0, 90.0)
    assert pole[14] == pytest.approx(6356752.314245, abs=1e-6)
    # the example of EPSG method 9602: 53 48' 33.820" N, 2 07' 46.380" E, 73 m
    north, east = 53 + 48 / 60 + 33.820 / 3600, 2 + 7 / 60 + 46.380 / 3600
    assert geo_transform(east, north, 73.0)[12:15] == pytest.approx(
        (3771793.968, 140253.342, 5124304.349), abs=2e-3
    )
    for wrong in ((0.0, 91.0), (400.0, 0.0), (0.0, math.nan)):
        with pytest.raises(ValueError, match="a latitude from -90 to 90"):
            geo_transform(*wrong)


def test_the_error_of_the_whole_tileset_is_in_the_units_of_its_place(tmp_path: Path) -> None:
    """Transforms scale the errors of tiles, but that of the tileset is outside of all tiles."""
    levels = FAST.levels(make("object", 2000, sh_degree=0, seed=2), [1.0, 0.05])
    plan = plan_stream(levels, chunk_gaussians=300)
    wide = (0.0, 2.5, 0.0, 0.0, -100.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 2.0, 3.0, 1.0)
    for name, transform in (("plain", None), ("wide", wide)):
        write_tiles(plan, tmp_path / name, transform=transform)
    plain, scaled = (
        json.loads((tmp_path / name / "tileset.json").read_text()) for name in ("plain", "wide")
    )
    assert scaled["geometricError"] == pytest.approx(100 * plain["geometricError"])
    assert scaled["root"]["geometricError"] == plain["root"]["geometricError"]


def test_levels_of_ones_own_need_no_sums_of_errors(tmp_path: Path) -> None:
    levels = FAST.levels(make("object", 2000, sh_degree=0, seed=2), [1.0, 0.1])
    names = ("scene", "geometric_error", "assignment")
    own = [SimpleNamespace(**{name: getattr(one, name) for name in names}) for one in levels]
    write_tiles(plan_stream(cast("Any", own)), tmp_path / "own")
    write_tiles(plan_stream(levels), tmp_path / "out")
    trees = [json.loads((tmp_path / name / "tileset.json").read_text()) for name in ("own", "out")]
    # One tile holds the whole level.
    assert trees[0]["root"]["geometricError"] == pytest.approx(trees[1]["root"]["geometricError"])
