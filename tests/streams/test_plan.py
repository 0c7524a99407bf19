"""Chunks and shares of streams by hand."""

import json
import time
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from cvtgs import load
from cvtgs.errors import DroppedDataWarning, InvalidArgumentError
from cvtgs.math.frames import robust_frame
from cvtgs.math.parameters import rotation_matrices
from cvtgs.report import rms_error
from cvtgs.streams import (
    StreamPlan,
    blocks,
    geo_transform,
    plan_stream,
    sog,
    stream_file,
    tiles,
    write_sog_stream,
    write_tiles,
)
from cvtgs.streams.plan import environment_level, near_rows, plan_part
from scenes import random_scene


def level(
    places: list[float], owners: list[int] | None, sums: list[list[float]] | None = None
) -> SimpleNamespace:
    """Return a level of Gaussians on a line."""
    error_sums = None if sums is None else torch.tensor(sums, dtype=torch.float64)
    means = torch.zeros(len(places), 3)
    means[:, 0] = torch.tensor(places)
    return SimpleNamespace(
        scene=random_scene(len(places)).with_tensors({"means": means}, {}),
        geometric_error=0.0 if error_sums is None else rms_error(error_sums),
        assignment=None if owners is None else torch.tensor(owners, dtype=torch.int32),
        error_sums=error_sums,
    )


def planned(*levels: SimpleNamespace, most: int) -> StreamPlan:
    near = torch.ones(len(levels[-1].scene), dtype=torch.bool)
    return plan_part(levels, near, chunk_gaussians=most)


@pytest.mark.parametrize(("owners", "chunk"), [([0, 1, 1], 1), ([1, 0, 0], 0), ([0, 0, 1], 0)])
def test_a_gaussian_is_in_the_chunk_of_the_coarse_one_with_most_of_its_rows(owners, chunk):
    """Wherever it lies: here, nearer to the first."""
    fine = level([0.1, 5.0], [0, 0, 0, 1])
    coarse = level([0.0, 5.0], [*owners, 1])
    rows = [one.rows for one in planned(fine, coarse, most=1).chunks]
    assert [own[1].tolist() for own in rows] == [[0], [1]]
    assert [0 in own[0].tolist() for own in rows] == [chunk == 0, chunk == 1]


@pytest.mark.slow
def test_any_number_of_threads_plans_the_same_chunks(two_threads):
    """Each fine Gaussian replaces three rows, two of them of one coarse Gaussian."""
    some, others = torch.randint(200, (2, 200_000), generator=torch.Generator().manual_seed(0))
    coarse_owners = torch.stack([some, some, others], dim=1).flatten()
    fine_owners = torch.arange(200_000).repeat_interleave(3)
    fine = level([0.0] * 200_000, fine_owners.tolist())
    coarse = level([float(place) for place in range(200)], coarse_owners.tolist())
    chunks = planned(fine, coarse, most=1).chunks
    for own in chunks:
        assert torch.equal(own.rows[0], (some == own.rows[1]).nonzero()[:, 0])
    assert sum(len(own.rows[0]) for own in chunks) == 200_000


def test_parts_of_about_equally_many_fine_gaussians():
    """Of 1, 1, 1 and 9 Gaussians, the last are a chunk of their own."""
    owners = [0, 1, 2, *[3] * 9]
    fine, coarse = level([float(row) for row in range(12)], None), level([0.0, 1, 2, 7], owners)
    chunks = planned(fine, coarse, most=9).chunks
    assert [own.rows[1].tolist() for own in chunks] == [[0, 1, 2], [3]]
    assert [len(own.rows[0]) for own in chunks] == [3, 9]


@pytest.mark.parametrize(("most", "chunks"), [(4, 1), (3, 2)])
def test_a_chunk_may_hold_as_many_gaussians_as_given(most: int, chunks: int) -> None:
    fine, coarse = level([0.0, 1, 2, 3], None), level([0.0, 2], [0, 0, 1, 1])
    assert len(planned(fine, coarse, most=most).chunks) == chunks


def test_a_gaussian_that_the_coarsest_level_left_out_is_in_the_nearest_chunk() -> None:
    fine, coarse = level([0.0, 6.0, 10.0], None), level([0.0, 10.0], [0, -1, 1])
    first, second = planned(fine, coarse, most=2).chunks
    assert (first.rows[0].tolist(), sorted(second.rows[0].tolist())) == ([0], [1, 2])


def test_gaussians_that_the_coarsest_level_left_out_take_no_quadratic_time():
    """Comparing all of them with all of the coarsest takes 3 s; half of a hazy scene may be so."""
    places, owners = torch.rand(20_000, generator=torch.Generator().manual_seed(0)), range(20_000)
    fine = level(places.tolist(), None)
    seconds = []
    for left_out in (0, 15_000):
        kept = [-1 if row < left_out else row % 5_000 for row in owners]
        coarse = level(places[-5_000:].tolist(), kept)
        start = time.process_time()
        chunks = planned(fine, coarse, most=5_000).chunks
        seconds.append(time.process_time() - start)
        assert sum(len(chunk.rows[0]) for chunk in chunks) == 20_000
    assert seconds[1] < seconds[0] + 0.5


def test_levels_that_require_gradients_are_planned():
    """Without torch's warning that a tensor became a number."""
    plain, tracked = level([0.0, 1.0, 5.0], None), level([0.0, 1.0, 5.0], None)
    tensors = {name: one.requires_grad_() for name, one in plain.scene.tensors().items()}
    tracked.scene = plain.scene.with_tensors(tensors)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = plan_stream([tracked])
    assert found.root.box_max == plan_stream([plain]).root.box_max


def test_a_box_reaches_three_deviations_along_every_axis():
    """And 6 % more. A needle along its own x, turned by 90 degrees about z, is one along y."""
    one = level([4.0], None)
    tensors = {
        "quats": torch.tensor([[0.5**0.5, 0, 0, 0.5**0.5]]),
        "log_scales": torch.tensor([[2.0, 0.5, 0.1]]).log(),
    }
    one.scene = one.scene.with_tensors(tensors, {})
    (chunk,) = planned(one, most=1).chunks
    assert chunk.box_min == pytest.approx((2.41, -6.36, -0.318), abs=1e-5)
    assert chunk.box_max == pytest.approx((5.59, 6.36, 0.318), abs=1e-5)


def test_boxes_hold_three_deviations_of_the_rounded_gaussians_of_a_sog(tmp_path: Path) -> None:
    """Scales have 256 different values in a file, and the largest are farthest apart."""
    one = level([0.0] * 2000, None)
    log_scales = torch.randn(2000, 3, generator=torch.Generator().manual_seed(1))
    one.scene = one.scene.with_tensors({"log_scales": log_scales})
    plan = planned(one, most=2000)
    write_sog_stream(plan, tmp_path)
    written = load(tmp_path)
    axes = rotation_matrices(written.quats) * written.scales[:, None, :]
    reach = (written.means + 3 * axes.square().sum(dim=2).sqrt()).amax(dim=0)
    assert (reach <= torch.tensor(plan.root.box_max)).all()


def test_tiles_state_their_own_error_but_none_below_that_of_a_child(tmp_path: Path) -> None:
    """Parts of the middle level are off by 1 and 5, the coarsest by 3; viewers take a sixteenth."""
    places = [float(place) for place in range(8)]
    levels = (
        level(places, None),
        level(places[::2], [0, 0, 1, 1, 2, 2, 3, 3], [[1, 1, 1, 3], [2, 0, 100, 0]]),
        level([1.0, 5.0], [0, 0, 0, 0, 1, 1, 1, 1], [[4, 4], [36, 36]]),
    )
    write_tiles(planned(*levels, most=4), tmp_path, tile_gaussians=2)
    root = json.loads((tmp_path / "tileset.json").read_text())["root"]
    assert root["geometricError"] == 16 * 5.0
    assert [child["geometricError"] for child in root["children"]] == [16 * 1.0, 16 * 5.0]
    leaves = [leaf for child in root["children"] for leaf in child["children"]]
    assert [leaf["geometricError"] for leaf in leaves] == [0.0, 0.0]


def test_parts_of_a_level_without_sums_have_its_error(tmp_path: Path) -> None:
    fine, coarse = level([0.0, 1, 2, 3], None), level([0.0, 2], [0, 0, 1, 1])
    coarse.geometric_error = 3.0
    write_tiles(planned(fine, coarse, most=2), tmp_path, tile_gaussians=2)
    root = json.loads((tmp_path / "tileset.json").read_text())["root"]
    assert root["geometricError"] == 16 * 3.0


CLAMPED = (
    "; view-dependent SH coefficients outside [-1.0625, 1.0625], which are clamped (6 Gaussians)"
)


@pytest.mark.parametrize(
    ("write", "most", "more"),
    [(write_sog_stream, "file_gaussians", ""), (write_tiles, "tile_gaussians", CLAMPED)],
)
def test_all_files_of_a_stream_give_one_warning(
    tmp_path: Path, write: Any, most: str, more: str
) -> None:
    """Two files have the four fine Gaussians, and one has the two coarse ones."""
    fine, coarse = level([0.0, 1, 2, 3], None), level([0.0, 2], [0, 0, 1, 1])
    for one in (fine, coarse):
        count = len(one.scene)
        large = {"sh0": torch.zeros(count, 1, 3), "shN": torch.full((count, 3, 3), 2.0)}
        one.scene = one.scene.with_tensors(large, {"own": torch.zeros(count)})
    with pytest.warns(DroppedDataWarning) as caught:
        write(planned(fine, coarse, most=2), tmp_path / "out", **{most: 2})
    (warning,) = caught
    assert str(warning.message) == (
        f"{tmp_path / 'out'}: the files of this stream, all levels together, do not hold extra "
        f"column 'own'{more}."
    )
    assert warning.filename == __file__


@pytest.mark.parametrize(
    ("limit", "files"), [(110, ["a0", "b0"]), (109, ["a1"]), (20, ["a1"]), (3, ["a2", "b2"])]
)
def test_all_parts_have_their_environment_at_one_level(
    limit: int, files: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The finest with few enough Gaussians in total, or the coarsest."""
    monkeypatch.setattr("cvtgs.streams.plan.ENVIRONMENT_GAUSSIANS", limit)
    parts = [
        SimpleNamespace(far=(60, 20, 3), environments={0: "a0", 1: "a1", 2: "a2"}),
        SimpleNamespace(far=(), environments={}),
        SimpleNamespace(far=(50, 0, 1), environments={0: "b0", 2: "b2"}),
    ]
    assert vars(sog)["_far_files"](parts) == files
    assert vars(sog)["_far_files"](parts[1:2]) == []


def test_no_environment_is_of_a_level_without_far_gaussians() -> None:
    assert environment_level([0, 3]) == 1


@pytest.mark.parametrize(
    ("counts", "files"),
    [
        ([2, 2, 2], [(0, 2), (2, 3)]),
        ([5, 1, 3], [(0, 1), (1, 3)]),
        ([1, 9, 1], [(0, 1), (1, 2), (2, 3)]),
    ],
)
def test_files_hold_as_many_chunks_as_fit_or_one(counts, files):
    found = vars(sog)["_packed"](counts, 4)
    assert [(chunks.start, chunks.stop) for chunks in found] == files


def test_every_block_with_rows_has_a_gaussian_at_every_level(tmp_path: Path) -> None:
    job = SimpleNamespace(
        source=SimpleNamespace(count=14),
        level_counts=(14, 6, 2),
        write_file=lambda name, content: (tmp_path / name).write_bytes(content),
    )
    share = vars(blocks)["_write_targets"]
    share(job, [12, 0, 1, 1], [[12.0, 0.0, 1.0, 1.0]] * 3)
    found = json.loads((tmp_path / "targets.json").read_text())["targets"]
    assert found == [[12, 4, 1], [0, 0, 0], [1, 1, 1], [1, 1, 1]]


@pytest.mark.parametrize("radii", [float("nan"), -1.0, "3"])
def test_a_distance_that_is_no_number_from_0_is_refused(radii: Any, tmp_path: Path) -> None:
    wanted = "the environment must begin at a number of radii, at least 0, found "
    with pytest.raises(InvalidArgumentError, match=wanted):
        plan_stream([level([0, 1], None), level([0], None)], environment_radii=radii)
    with pytest.raises(InvalidArgumentError, match=wanted):
        stream_file("none.ply", tmp_path, [0.5], kind="sog", environment_radii=radii)


def test_the_environment_begins_at_radii_of_the_full_scene() -> None:
    """Of 100 Gaussians, four far ones are a third of the small scene, and stretch its own frame."""
    places = [0.01 * number for number in range(96)] + [60.0, 70.0, 80.0, 90.0]
    fine_places = [0.1, 0.3, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, *places[96:]]
    owners = [number // 12 for number in range(96)] + [8, 9, 10, 11]
    fine = level(fine_places, owners)
    coarse = level([0.5, *places[96:]], [0] * 96 + [1, 2, 3, 4])
    plan = plan_stream([fine, coarse], environment_radii=20.0)
    assert plan.environment is not None
    assert [len(rows) for rows in plan.far] == [4, 4]


def test_the_nearest_gaussian_is_never_in_the_environment() -> None:
    scene = random_scene(20)
    frame = robust_frame(scene.means)
    near = near_rows(scene, frame, 0.0)
    assert near.nonzero()[:, 0].tolist() == [int(frame.distances(scene.means).argmin())]


def test_a_tile_above_blocks_has_an_error_of_its_diagonal_at_least() -> None:
    """So a viewer that is inside its box always loads the blocks."""
    for error, wanted in ((1.0, 5.0), (7.0, 7.0)):
        corners = (0.0, 0.0, 0.0), (3.0, 4.0, 0.0)
        child = {"geometricError": error, "transform": geo_transform(0.0, 0.0)}
        found = vars(tiles)["_parent"](*corners, [child])
        assert found["geometricError"] == wanted
