"""Warnings point at the line of the program that called cvtgs, whichever function it called."""

import gc
import sys
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import plyfile
import pytest
import torch

import cvtgs
from cvtgs.cameras import Cameras
from cvtgs.errors import CameraWarning, DroppedDataWarning, warn, without_warnings
from cvtgs.levels import write_levels
from cvtgs.scene import GaussianScene
from cvtgs.synthetic import scene as make

Call = Callable[[GaussianScene, Path], object]


def simplifier() -> cvtgs.Simplifier:
    return cvtgs.Simplifier(None, preset="draft")


def cameras() -> Cameras:
    return cvtgs.views.automatic_views(make("object", 300), 2, width=16, height=16)


def write_splats(scene: GaussianScene, folder: Path) -> None:
    levels = simplifier().levels(scene, [0.5])
    write_levels(levels, folder / "levels", rhos=[0.5], source="a", suffix=".splat")


def with_bad_row(scene: GaussianScene) -> GaussianScene:
    means = scene.means.clone()
    means[3] = torch.nan
    return scene.with_tensors(means=means)


def with_other_rows(folder: Path) -> Path:
    """Write a file with a second element, which readers leave out."""
    path = folder / "two.ply"
    make("object", 300).save(path)
    data = path.read_bytes().replace(
        b"end_header", b"element other 1\nproperty uchar grey\nend_header"
    )
    path.write_bytes(data + b"\0")
    return path


CALLS: dict[str, Call] = {
    "save": lambda scene, folder: cvtgs.save(scene, folder / "a.splat"),
    "scene.save": lambda scene, folder: scene.save(folder / "a.splat"),
    "write_levels": write_splats,
    "simplify": lambda scene, _: cvtgs.simplify(with_bad_row(scene), 0.5, preset="draft"),
    "Simplifier.run": lambda scene, _: simplifier().run(with_bad_row(scene), 0.5),
    "Simplifier.levels": lambda scene, _: simplifier().levels(with_bad_row(scene), [0.5]),
    "Prepared.run": lambda scene, _: simplifier().prepare(with_bad_row(scene)).run(count=9),
    "load": lambda _, folder: cvtgs.load(with_other_rows(folder)),
    "a path": lambda _, folder: simplifier().simplify(with_other_rows(folder), 0.5),
    "describe a path": lambda _, folder: cvtgs.describe(with_other_rows(folder)),
    "views of a path": lambda _, folder: cvtgs.views.automatic_views(with_other_rows(folder), 1),
    "evaluate a path": lambda scene, folder: cvtgs.evaluate(
        with_other_rows(folder), {"a": scene}, cameras()
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CALLS)
def test_a_warning_points_at_the_program(name: str, tmp_path: Path) -> None:
    scene = make("object", 300, sh_degree=1)
    with pytest.warns(DroppedDataWarning) as caught:
        CALLS[name](scene, tmp_path)
    assert {one.filename for one in caught} == {__file__}


def test_every_line_of_a_program_is_warned_once(tmp_path: Path) -> None:
    """The default filter shows a text once per line: two places give two warnings."""
    scene = make("object", 300, sh_degree=1)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        for number in range(3):
            scene.save(tmp_path / "a.splat", overwrite=number > 0)
        scene.save(tmp_path / "a.splat", overwrite=True)
    assert len(caught) == 2


READINGS = (".ply", ".sog", ".pt")


def write_as(suffix: str, scene: GaussianScene, folder: Path) -> Path:
    """Write a scene as text, as images, or as a checkpoint with a number of numpy."""
    path = folder / f"scene{suffix}"
    if suffix == ".pt":
        torch.save({"splats": cvtgs.to_dict(scene), "rate": np.float64(0.1)}, path)
        return path
    scene.save(path)
    if suffix == ".ply":
        text = plyfile.PlyData.read(path, mmap=False)
        text.text = True
        text.write(path)
    return path


@pytest.mark.parametrize("suffix", READINGS)
def test_reading_leaves_the_filters_of_the_process_alone(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Threads that change the filters at once leave them changed, with all warnings ignored."""
    path, true = write_as(suffix, make("object", 300), tmp_path), warnings.catch_warnings

    def watched(*args: Any, **values: Any) -> Any:
        caller = sys._getframe(1).f_globals["__name__"]
        assert not caller.startswith("cvtgs"), caller
        return true(*args, **values)

    monkeypatch.setattr(warnings, "catch_warnings", watched)
    assert len(cvtgs.load(path)) == 300


def test_reading_text_closes_its_file(tmp_path: Path) -> None:
    path = write_as(".ply", make("object", 30), tmp_path)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        cvtgs.load(path)
        gc.collect()
    assert not caught


def test_left_out_warnings_are_those_of_a_category_in_one_thread() -> None:
    with warnings.catch_warnings(record=True) as caught, ThreadPoolExecutor(1) as pool:
        warnings.simplefilter("always")
        with without_warnings(DroppedDataWarning):
            warn("dropped", DroppedDataWarning)
            warn("something else")
            pool.submit(warn, "of another thread", DroppedDataWarning).result()
        warn("later", DroppedDataWarning)
    found = [str(one.message) for one in caught]
    assert found == ["something else", "of another thread", "later"]


def test_left_out_warnings_stay_left_out_within_inner_ones() -> None:
    """The inner ones leave out a category in addition."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with without_warnings(DroppedDataWarning):
            with without_warnings(CameraWarning):
                warn("dropped", DroppedDataWarning)
                warn("of cameras", CameraWarning)
            warn("of cameras again", CameraWarning)
    assert [str(one.message) for one in caught] == ["of cameras again"]
