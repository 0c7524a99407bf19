"""The cache: everything is computed once, and equals a fresh computation."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from camera_files import pose, transforms, write_json
from cvtgs import GaussianScene
from cvtgs.config import SimplifyConfig
from cvtgs.errors import OutputError
from cvtgs.tags import ANTIALIASED
from cvtgs.train import Source, TrainConfig, ViewsConfig
from cvtgs.train.cases import make_case, render_targets
from cvtgs.train.scenes import prepare_scene
from train_cases import (
    bits_of_case,
    bits_of_views,
    small_scene,
    source_of,
    tiny_config,
    tiny_data,
)

RATIOS = (0.2, 0.05)


def config_of(**changes) -> TrainConfig:
    data = tiny_data(Path(), ratios=RATIOS, validation_ratios=(0.3,))
    return tiny_config(changes.pop("data", data), **changes)


class Counting:
    """Makes a scene, and counts how often."""

    def __init__(self, scene: GaussianScene) -> None:
        self.scene, self.count = scene, 0

    def __call__(self) -> GaussianScene:
        self.count += 1
        return self.scene


@pytest.fixture
def made() -> Counting:
    return Counting(small_scene(300))


@pytest.fixture
def source(made) -> Source:
    return replace(source_of(made.scene), make=made)


def files_in(folder: Path) -> dict[str, int]:
    return {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}


@pytest.mark.slow
def test_a_scene_is_made_once(source, made, tmp_path):
    first = prepare_scene(source, config_of(), tmp_path)
    assert made.count == 1
    files = files_in(tmp_path)
    again = prepare_scene(source, config_of(), tmp_path)
    assert made.count == 1
    assert files_in(tmp_path) == files
    assert [bits_of_case(case) for case in again.cases] == [bits_of_case(c) for c in first.cases]
    assert [bits_of_views(v) for v in again.views] == [bits_of_views(v) for v in first.views]


def mapped_file(tensor: torch.Tensor) -> str:
    """The file whose pages hold a tensor."""
    for line in Path("/proc/self/maps").read_text(encoding="utf-8").splitlines():
        words = line.split(maxsplit=5)  # a path may have spaces
        start, end = (int(text, 16) for text in words[0].split("-"))
        if start <= tensor.data_ptr() < end:
            return words[5] if len(words) > 5 else ""
    return ""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="needs Linux")
def test_cases_take_no_memory(source, tmp_path):
    """All large tensors stay in the file, or hundreds of cases would fill the memory."""
    for case in prepare_scene(source, config_of(), tmp_path).cases:
        reference, seen = case.reference, case.descriptors
        tensors = [reference.partition.order, reference.neighbors, reference.visibility]
        tensors += [*reference.scene.tensors().values(), *reference.merged.tensors().values()]
        tensors += [getattr(seen, name) for name in type(seen).__slots__]
        files = {mapped_file(values) for values in tensors if values.numel()}
        assert len(files) == 1
        assert files.pop().startswith(str(tmp_path))


@pytest.mark.long
def test_cached_results_equal_fresh_ones(source, made, tmp_path):
    config = config_of()
    for prepared in (
        prepare_scene(source, config, tmp_path),
        prepare_scene(source, config, tmp_path),
    ):
        assert prepared.name == "made"
        for ratio, case in zip(RATIOS, prepared.cases, strict=True):
            fresh = make_case("made", made.scene, ratio, SimplifyConfig())
            assert bits_of_case(case) == bits_of_case(fresh)
        for place, (size, views) in enumerate(zip((32, 40), prepared.views, strict=True)):
            fresh = render_targets(made.scene, 4, size=size, seed=place)
            assert bits_of_views(views) == bits_of_views(fresh)
            assert set(views.cameras.ignores_tag) == {True, False}


@pytest.mark.slow
def test_scenes_for_validation_have_their_own_ratios_and_views(made, tmp_path):
    source = replace(source_of(made.scene, is_validation=True), make=made)
    prepared = prepare_scene(source, config_of(), tmp_path)
    assert [case.ratio for case in prepared.cases] == [0.3]
    assert [tuple(views.rgb.shape) for views in prepared.views] == [(2, 36, 36, 3)]


def test_cameras_of_a_file_are_spread_evenly_and_fitted(made, tmp_path):
    """Three of the four, at the size of the validation; other cameras make new images."""
    file = tmp_path / "made.transforms.json"
    source = replace(source_of(made.scene, is_validation=True), make=made, cameras=file)
    config = config_of()
    config = config.model_copy(
        update={"views": config.views.model_copy(update={"validation_count": 3})}
    )
    for first in (0, 4):
        write_json(file, transforms(range(first, first + 4)))
        (views,) = prepare_scene(source, config, tmp_path).views
        assert tuple(views.rgb.shape) == (3, 27, 36, 3)
        places = [torch.tensor(pose(first + row)[1]) for row in range(3)]
        torch.testing.assert_close(views.cameras.centers, torch.stack(places))


@pytest.mark.slow
def test_training_on_a_former_validation_scene_makes_new_images(source, made, tmp_path):
    """Also where both have the same ratios."""
    config = tiny_config(tiny_data(Path(), ratios=(0.2,), validation_ratios=(0.2,)))
    prepare_scene(replace(source, is_validation=True), config, tmp_path)
    prepared = prepare_scene(source, config, tmp_path)
    assert made.count == 2
    assert [len(views.cameras) for views in prepared.views] == [4, 4]


@pytest.mark.slow
def test_a_ratio_that_leaves_nothing_to_merge_has_no_cases(tmp_path):
    few = small_scene(300).select(torch.arange(3))
    scene = few.with_tensors(
        {"log_scales": few.log_scales + 3}, {}
    )  # they overlap, so none is isolated
    for _ in range(2):
        prepared = prepare_scene(source_of(scene), config_of(), tmp_path)
        assert [case.ratio for case in prepared.cases] == [0.2, 0.05]
    config = tiny_config(tiny_data(Path(), ratios=(0.9,)))
    for _ in range(2):
        prepared = prepare_scene(source_of(scene), config, tmp_path)
        assert prepared.cases == ()
        assert len(prepared.views) == 2


@pytest.mark.parametrize(
    ("changes", "images", "cases"),
    [
        ({"seed": 1}, 1, 0),
        ({"preset": "paper"}, 0, 1),
        ({"data": tiny_data(Path(), ratios=(0.2, 0.06))}, 0, 1),
        ({"views": ViewsConfig(count=3, sizes=(32,))}, 1, 0),
        ({"views": ViewsConfig(count=4, sizes=(32,))}, 1, 0),
        ({"steps": 1000, "learning_rate": 0.1, "kind": "local", "width": 9}, 0, 0),
    ],
    ids=["seed", "preset", "ratios", "count", "sizes", "nothing that matters"],
)
@pytest.mark.long
def test_only_results_affected_by_a_change_are_recomputed(
    source, made, tmp_path, changes, images, cases
):
    prepare_scene(source, config_of(), tmp_path)
    before = files_in(tmp_path)
    assert len(before) == 2
    prepare_scene(source, config_of(**changes), tmp_path)
    after = files_in(tmp_path)
    new = sorted(after.keys() - before.keys())
    assert sum("-views-" in name for name in new) == images
    assert sum("-cases-" in name for name in new) == cases
    assert {name: after[name] for name in before} == before
    assert made.count == 1 + (images + cases > 0)


@pytest.mark.slow
def test_another_identity_is_cached_separately(source, made, tmp_path):
    prepare_scene(source, config_of(), tmp_path)
    prepare_scene(replace(source, identity="another"), config_of(), tmp_path)
    assert made.count == 2
    assert len(files_in(tmp_path)) == 4


DAMAGE = {
    "empty": lambda content: b"",
    "cut short": lambda content: content[:-100],
    "garbage": lambda content: b"?" * 1000,
    "without a tensor": lambda content: content.replace(b"0/order", b"0/odder", 1).replace(
        b"0/alpha", b"0/alphb", 1
    ),
}


@pytest.mark.long
@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_a_damaged_file_is_recomputed(source, made, tmp_path, damage):
    first = prepare_scene(source, config_of(), tmp_path)
    wanted = [bits_of_case(case) for case in first.cases], [bits_of_views(v) for v in first.views]
    for path in tmp_path.iterdir():
        content = path.read_bytes()
        path.unlink()
        path.write_bytes(damage(content))
        again = prepare_scene(source, config_of(), tmp_path)
        assert path.read_bytes() == content
        found = [bits_of_case(case) for case in again.cases]
        assert (found, [bits_of_views(views) for views in again.views]) == wanted
    assert made.count == 3


@pytest.mark.slow
def test_an_antialiased_scene_stays_antialiased(tmp_path):
    """Its merged Gaussians are rendered antialiased, too."""
    scene = replace(small_scene(300), comments=(ANTIALIASED.text,))
    for _ in range(2):
        case = prepare_scene(source_of(scene), config_of(), tmp_path).cases[1]
        assert case.reference.merged.antialiased
        assert bits_of_case(case) == bits_of_case(
            make_case("made", scene, RATIOS[1], SimplifyConfig())
        )


@pytest.mark.slow
def test_a_missing_folder_is_an_error(source, tmp_path):
    with pytest.raises(OutputError):
        prepare_scene(source, config_of(), tmp_path / "nowhere")
