"""The catalogue of hard cases, and the stages that treat rows separately: io and filters."""

import re
import warnings

import pytest
import torch

import cvtgs
import hard_cases
from cvtgs.errors import DroppedDataWarning
from cvtgs.filters import flyaway_rows, visible_rows
from cvtgs.math.frames import robust_frame
from cvtgs.validity import invalid_rows, standardized
from hard_cases import CASES, each_case
from hard_scenes import DEVICES, ball, changed, dtypes, simplifier, valid_rows
from scenes import assert_standard, same_bits

COUNT = 60
pytestmark = pytest.mark.usefixtures("coarse_light")


def test_every_case_is_in_the_catalogue_and_states_its_source():
    own = {
        name: value
        for name, value in vars(hard_cases).items()
        if callable(value) and getattr(value, "__module__", "") == "hard_cases"
        if not name.startswith("__")
    }
    assert own == {name: make for name, make in CASES.items() if name != "ball"}
    assert len(own) >= 35
    for make in own.values():
        assert re.search(r"\. *\s+Source: \w.*\.$", make.__doc__.strip(), re.DOTALL), make.__name__


@dtypes
@each_case
@pytest.mark.slow
def test_each_case(make, dtype, subtests, tmp_path):
    """Files keep the case, filters find its faults, and its results can be saved and loaded."""
    scene = make(COUNT, dtype)
    with subtests.test("the case is as described"):
        check_that_the_case_is_as_described(make, scene, dtype)
    with subtests.test("files keep every bit"):
        check_that_files_keep_every_bit(scene, tmp_path)
    with subtests.test("results can be saved and loaded"):
        preset = "standard" if dtype == torch.float32 else "paper"
        check_that_results_can_be_saved_and_loaded(make, scene, preset, tmp_path)
    valid = scene.select(valid_rows(scene))
    with subtests.test("only flyaways are found as flyaways"):
        check_that_only_flyaways_are_found(make, valid)
    for device in DEVICES:
        with subtests.test("invalid rows are found by their property", device=device):
            check_that_invalid_rows_are_found(make, scene, device)
        with subtests.test("the filtered mass is bounded", device=device):
            check_that_the_filtered_mass_is_bounded(valid.to(device))
        with subtests.test("valid rows become standard without other changes", device=device):
            check_that_valid_rows_become_standard(valid.to(device))


def check_that_the_case_is_as_described(make, scene, dtype):
    assert scene.dtype == dtype
    assert len(scene) == {"one": 1, "two": 2, "three": 3}.get(make.__name__, COUNT)
    spoiled = make.__name__.startswith("nan_") or make.__name__ == "zero_quaternions"
    assert bool(valid_rows(scene).all()) is not spoiled
    if make is not CASES["half_precision"]:
        assert make is CASES["ball"] or not same_bits(scene, ball(COUNT, dtype)) or scene.comments


def check_that_files_keep_every_bit(scene, tmp_path):
    cvtgs.save(scene, tmp_path / "case.ply")
    read = cvtgs.load(tmp_path / "case.ply")
    assert same_bits(read, scene)
    assert read.comments == scene.comments
    assert scene.layout in ((), read.layout)
    before = (tmp_path / "case.ply").read_bytes()
    cvtgs.save(read, tmp_path / "again.ply")
    assert (tmp_path / "again.ply").read_bytes() == before


def check_that_results_can_be_saved_and_loaded(make, scene, preset, tmp_path):
    """Results of 2DGS files lose their third scale, with a warning: the file has none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DroppedDataWarning)
        small = simplifier(preset).simplify(scene, 0.2)
        cvtgs.save(small, tmp_path / "small.ply")
    read = cvtgs.load(tmp_path / "small.ply")
    if make is CASES["flat_file"]:
        assert "scale_2" not in dict(read.layout)
        flat = small.log_scales.clone()
        flat[:, 2] = -20.0
        small = changed(small, log_scales=flat)
    assert same_bits(read, small)


def test_a_file_without_a_third_scale_is_written_without_one(tmp_path):
    cvtgs.save(CASES["flat_file"](COUNT, torch.float32), tmp_path / "flat.ply")
    header = (tmp_path / "flat.ply").read_bytes().split(b"end_header")[0]
    assert b"scale_1" in header
    assert b"scale_2" not in header
    read = cvtgs.load(tmp_path / "flat.ply")
    assert read.log_scales[:, 2].unique().tolist() == [-20.0]
    small = simplifier("standard").simplify(read, 0.5)
    cvtgs.save(small, tmp_path / "small.ply")  # warnings are errors here: nothing is lost
    assert b"scale_2" not in (tmp_path / "small.ply").read_bytes().split(b"end_header")[0]


def test_half_precision_becomes_float32_without_rounding():
    scene = CASES["half_precision"](COUNT, torch.float32)
    assert torch.equal(scene.means.half().float(), scene.means)
    assert not torch.equal(scene.means, ball(COUNT, torch.float32).means)


# Filters


def check_that_invalid_rows_are_found(make, scene, device):
    found = invalid_rows(scene.to(device))
    bad = torch.stack([*found.values(), torch.zeros(len(scene), device=device) > 0]).any(dim=0)
    assert torch.equal(bad.cpu(), ~valid_rows(scene))
    name = make.__name__.removeprefix("nan_")
    names = {"zero_quaternions": ["quats"]}.get(name, [name] if name in scene.tensors() else [])
    assert list(found) == names


def check_that_the_filtered_mass_is_bounded(scene):
    opacities, masses = scene.opacities, scene.masses
    for share, at_least in ((1.0, 1), (1.0, len(scene)), (0.01, 1), (0.01, len(scene) // 2 + 1)):
        keep = visible_rows(
            opacities, masses, min_opacity=0.1, max_mass_share=share, at_least=at_least
        )
        assert int(keep.sum()) >= at_least
        assert bool(keep[opacities >= 0.1].all())
        if share < 1:
            assert float(masses[~keep].sum()) <= share * float(masses.sum())


def check_that_only_flyaways_are_found(make, scene):
    distances = robust_frame(scene.means).distances(scene.means)
    assert bool(distances.isfinite().all())
    seen = scene.masses * distances.clamp_min(1).pow(-2)
    rows = flyaway_rows(distances, seen, max_share=1e-3).nonzero()[:, 0].tolist()
    assert rows == ([0, 1, 2, 3, 4] if "flyaways" in make.__name__ else [])


def test_equally_faint_gaussians_are_filtered_by_mass_not_by_row():
    scene = CASES["all_faint"](COUNT, torch.float32)
    shuffle = torch.randperm(COUNT, generator=torch.Generator().manual_seed(0))
    keeps = [
        visible_rows(s.opacities, s.masses, min_opacity=0.1, max_mass_share=0.05, at_least=1)
        for s in (scene, scene.select(shuffle))
    ]
    assert int((~keeps[0]).sum()) >= 3
    assert torch.equal(keeps[0][shuffle], keeps[1])
    assert float(scene.masses[~keeps[0]].amax()) <= float(scene.masses[keeps[0]].amin())


def check_that_valid_rows_become_standard(scene):
    small = standardized(scene)
    assert_standard(small)
    for name in ("means", "log_scales", "sh0", "shN"):
        assert torch.equal(small.tensors()[name], scene.tensors()[name])
    cosines = torch.nn.functional.cosine_similarity(
        small.quats.double(), scene.quats.double() / scene.quats.double().abs().amax(1)[:, None]
    )
    assert float(cosines.amin()) > 1 - 1e-5
