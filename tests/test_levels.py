"""Several sizes of one scene: exact counts, the same as single runs, files."""

import json
import math
from pathlib import Path

import pytest
import torch

import cvtgs
from cvtgs import Simplifier
from cvtgs.analysis import analyze
from cvtgs.cli.main import main
from cvtgs.errors import DroppedDataWarning, InvalidArgumentError, OutputError, OutputExistsError
from cvtgs.evaluation.scorer import ImageScores, scene_scores
from cvtgs.levels import LevelEntry, LevelsIndex, check_levels, level_names, write_levels
from scenes import random_scene, same_bits

RHOS = [0.2, 0.04, 0.004]


@pytest.fixture(scope="module")
def scene():
    return cvtgs.synthetic.scene("object", 3000, sh_degree=1, seed=2)


@pytest.fixture(scope="module")
def simplifier():
    return Simplifier(device="cpu")


@pytest.mark.parametrize("rhos", [RHOS, RHOS[::-1], [0.04, 1.0, 0.2], [0.1, 0.09, 0.1], [0.5]])
@pytest.mark.slow
def test_counts_are_exact_and_in_the_order_of_the_ratios(scene, simplifier, rhos):
    levels = simplifier.levels(scene, rhos)
    assert [len(level.scene) for level in levels] == [cvtgs.target_count(3000, r) for r in rhos]
    for level, rho in zip(levels, rhos, strict=True):
        assert level.report.output_count == level.report.target_count == len(level.scene)
        assert level.report.rho == pytest.approx(rho)
        assert level.report.shortfall == ""
        assert len(cvtgs.validity.invalid_rows(level.scene)) == 0


@pytest.mark.parametrize("config", ["standard", "paper", "draft"])
@pytest.mark.slow
def test_levels_equal_single_runs(scene, config):
    simplifier = Simplifier(config=config, device="cpu")
    rhos = [1.0, *RHOS]
    for level, rho in zip(simplifier.levels(scene, rhos), rhos, strict=True):
        small, report = simplifier.run(scene, rho)
        assert same_bits(level.scene, small)
        assert level.report.filtered_count == report.filtered_count


def test_errors_grow_and_are_zero_at_a_ratio_of_one(scene, simplifier):
    errors = [level.geometric_error for level in simplifier.levels(scene, [1.0, *RHOS])]
    assert errors[0] == 0.0
    assert errors == sorted(errors)
    assert len(set(errors)) == 4


def test_errors_are_weighted_by_the_mass_as_seen_from_the_middle():
    scene = random_scene(300)
    (level,) = Simplifier(None, device="cpu").levels(scene, [0.1])
    analysis, rows = analyze(scene, cvtgs.SimplifyConfig()), level.assignment.long()
    shifts = scene.means - level.scene.means[rows.clamp_min(0)]
    errors = [
        ((masses * shifts.square().sum(dim=1)).sum() / masses.sum()).sqrt()
        for areas in (analysis.apparent_areas, analysis.areas)
        for masses in [(areas * analysis.opacities).where(rows >= 0, 0.0)]
    ]
    assert level.geometric_error == pytest.approx(float(errors[0]), rel=1e-4)
    assert level.geometric_error != pytest.approx(float(errors[1]), rel=1e-2)


def test_error_sums_are_those_of_the_rows_that_each_small_gaussian_replaces(monkeypatch):
    """Also of cells that two chunks of rows share."""
    monkeypatch.setattr("cvtgs.pipeline.CHUNK", 37)
    scene = random_scene(300)
    (level,) = Simplifier(None, device="cpu").levels(scene, [0.1])
    analysis, rows = analyze(scene, cvtgs.SimplifyConfig()), level.assignment.long()
    kept = rows >= 0
    squares = (scene.means - level.scene.means[rows.clamp_min(0)]).square().sum(dim=1)
    masses = analysis.apparent_areas * analysis.opacities
    sums = torch.stack([masses, masses * squares])[:, kept].double()
    wanted = torch.zeros(2, 30, dtype=torch.float64).index_add_(1, rows[kept], sums)
    torch.testing.assert_close(level.error_sums, wanted, rtol=1e-4, atol=1e-9)
    total, distances = level.error_sums.sum(dim=1).tolist()
    assert level.geometric_error == pytest.approx(math.sqrt(distances / total))


@pytest.mark.slow
def test_errors_are_those_of_the_refined_level():
    scene = random_scene(300)
    refined = {"steps": 5, "size": 32, "heldout": 2}
    config = cvtgs.SimplifyConfig.from_mapping({"refine": refined})
    (level,) = Simplifier(None, config=config, device="cpu").levels(scene, [0.1])
    assert level.report.refinement.changed_count > 0
    analysis, rows = analyze(scene, config), level.assignment.long()
    squares = (scene.means - level.scene.means[rows.clamp_min(0)]).square().sum(dim=1)
    masses = (analysis.apparent_areas * analysis.opacities).where(rows >= 0, 0.0)
    wanted = float(((masses * squares).sum() / masses.sum()).sqrt())
    assert level.geometric_error == pytest.approx(wanted, rel=1e-5)


def test_a_wrong_name_of_axes_leaves_the_index_alone(scene, simplifier, tmp_path):
    levels = simplifier.levels(scene, RHOS)
    write_levels(levels, tmp_path, rhos=RHOS, source="a")
    before = (tmp_path / "levels.json").read_bytes()
    for axes in ("", "xyz"):
        with pytest.raises(InvalidArgumentError, match="axes must be the directions of x, y"):
            write_levels(levels, tmp_path, rhos=RHOS, source="a", axes=axes, overwrite=True)
    assert (tmp_path / "levels.json").read_bytes() == before


def test_invalid_rows_are_counted_once_in_every_report(simplifier):
    scene = random_scene(200)
    means = scene.means.clone()
    means[3] = torch.nan
    with pytest.warns(DroppedDataWarning, match="dropped 1 of 200") as warned:
        levels = simplifier.levels(scene.with_tensors({"means": means}, {}), [1.0, 0.5, 0.05])
    assert len(warned) == 1
    assert [len(level.scene) for level in levels] == [199, 100, 10]
    assert [level.report.invalid_count for level in levels] == [1, 1, 1]
    assert [bool(level.report.shortfall) for level in levels] == [True, False, False]
    whole, half, _ = (level.assignment.tolist() for level in levels)
    assert whole == [0, 1, 2, -1, *range(3, 199)]
    assert (len(half), half[3], sorted(set(half))) == (200, -1, list(range(-1, 100)))
    assert simplifier.levels(random_scene(20), [1.0])[0].assignment is None


def test_no_ratio_and_bad_ratios_are_refused(scene, simplifier):
    for wrong in ([], 0.1):
        with pytest.raises(InvalidArgumentError, match="levels need a list of ratios, found"):
            simplifier.levels(scene, wrong)
    with pytest.raises(InvalidArgumentError, match="rho must be above 0"):
        simplifier.levels(scene, [0.1, 2.0])


def test_the_index_describes_the_files(scene, simplifier, tmp_path):
    folder = tmp_path / "levels"
    index = write_levels(
        simplifier.levels(scene, RHOS), folder, rhos=RHOS, source=Path("scene.ply"), suffix=".ply"
    )
    read = LevelsIndex.model_validate_json((folder / "levels.json").read_text())
    assert read == index
    assert read.source == "scene.ply"
    assert [level.file for level in read.levels] == list(level_names(RHOS))
    for level in read.levels:
        small = cvtgs.load(folder / level.file)
        assert level.count == len(small)
        assert level.bytes == (folder / level.file).stat().st_size
        assert level.box_min == tuple(small.means.amin(dim=0).tolist())
        assert level.psnr is None
    with pytest.raises(OutputExistsError):
        write_levels(simplifier.levels(scene, RHOS), folder, rhos=RHOS, source="scene.ply")


def test_wrong_arguments_are_refused_before_files_are_written(scene, simplifier, tmp_path):
    levels = simplifier.levels(scene, [0.01, 0.02])
    for those, rhos, message in (
        ([], [], r"those that Simplifier\.levels returns, found \[\]"),
        ([scene], [0.01], r"those that Simplifier\.levels returns, found \[GaussianScene"),
        (
            [*levels, *simplifier.levels(scene[:1000], [0.03])],
            [0.01, 0.02, 0.03],
            "must be of one scene, found scenes of 1,000 and 3,000 Gaussians",
        ),
        (
            levels,
            [0.01],
            r"in their order, .*; found \[0\.01\] for \[30, 60\] of 3,000 Gaussians\.",
        ),
        (
            [levels[0]] * 2,
            [0.01, 0.01],
            r"and differ, .*; found \[0\.01, 0\.01\] for \[30, 30\] of",
        ),
        (levels, [0.01, -3], r"rho must be above 0 and at most 1; found -3\."),
        (levels, [0.01, math.nan], r"rho must be above 0 and at most 1; found nan\."),
        (levels, [0.01, "a"], r"rho must be a number above 0 and at most 1; found 'a'\."),
        (
            levels,
            [0.02, 0.01],
            r"in their order, .*; found \[0\.02, 0\.01\] for \[30, 60\] of 3,000",
        ),
        (levels, 0.01, r"ratios must be a list of numbers, found 0\.01\."),
    ):
        with pytest.raises(InvalidArgumentError, match=message):
            write_levels(those, tmp_path / "out", rhos=rhos, source="a.ply")
    assert not (tmp_path / "out").exists()


def test_the_index_has_ratios_of_float32_as_they_were_written(scene, simplifier, tmp_path):
    rhos = torch.tensor([0.02, 0.01])
    levels = simplifier.levels(scene, rhos)
    index = write_levels(levels, tmp_path / "out", rhos=rhos, source="/my/scenes/a.ply")
    assert index.source == "a.ply"
    assert [(level.rho, level.file) for level in index.levels] == [
        (0.02, "rho_0.02.ply"),
        (0.01, "rho_0.01.ply"),
    ]


@pytest.mark.filterwarnings("ignore::cvtgs.errors.DroppedDataWarning")
@pytest.mark.parametrize("axes", ["rdf", "luf"])
@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".spz", ".splat", ".sog"])
@pytest.mark.slow
def test_boxes_counts_and_errors_match_the_files(scene, simplifier, tmp_path, suffix, axes):
    levels = simplifier.levels(scene, RHOS)
    write_levels(levels, tmp_path / "out", rhos=RHOS, source="a.ply", suffix=suffix, axes=axes)
    index = json.loads((tmp_path / "out" / "levels.json").read_text())
    assert len(index["levels"]) == len(RHOS)
    for entry in index["levels"]:
        path = tmp_path / "out" / entry["file"]
        stored, small = cvtgs.load(path, axes="rdf"), cvtgs.load(path, axes=axes)
        assert entry["count"] == len(stored)
        assert entry["bytes"] == path.stat().st_size
        assert entry["box_min"] == stored.means.amin(dim=0).tolist()
        assert entry["box_max"] == stored.means.amax(dim=0).tolist()
        level = levels[RHOS.index(entry["rho"])]
        assert entry["geometric_error"] == level.geometric_error
        wanted, found = (mean_distance(scene, other) for other in (level.scene, small))
        assert found == pytest.approx(wanted, rel=0.02)  # so the error also holds for the file
        assert 0.5 < found / entry["geometric_error"] < 1.1


@pytest.mark.slow
def test_scores_are_measured_on_the_files(scene, tmp_path):
    """A .splat file drops the view-dependent colours, which its score shows."""
    cvtgs.save(scene, tmp_path / "in.ply")
    words = ["levels", str(tmp_path / "in.ply"), "--rho", "0.1", "--views", "2", "--size", "32"]
    psnr = {}
    for suffix in (".ply", ".splat"):
        out = tmp_path / suffix[1:]
        assert main([*words, "-o", str(out), "--suffix", suffix, "--quiet"]) == 0
        psnr[suffix] = json.loads((out / "levels.json").read_text())["levels"][0]["psnr"]
    assert psnr[".splat"] != psnr[".ply"]
    cameras = cvtgs.views.automatic_views(scene, 2, width=32, height=24)
    files = {suffix: cvtgs.load(tmp_path / suffix[1:] / f"rho_0.1{suffix}") for suffix in psnr}
    for one in cvtgs.evaluate(scene, files, cameras).scenes:
        assert psnr[one.name] == pytest.approx(one.psnr.mean)


def mean_distance(scene, small):
    """Return the RMS distance to the nearest Gaussian of the small scene, weighted by mass."""
    squares = torch.cdist(scene.means, small.means).amin(dim=1).double() ** 2
    return float(((scene.masses * squares).sum() / scene.masses.sum()).sqrt())


def test_every_score_has_its_own_place_in_the_index():
    corner = (0.0, 0.0, 0.0)
    entry = LevelEntry(
        file="a.ply", rho=0.1, count=9, bytes=1, geometric_error=0.0, box_min=corner,
        box_max=corner, seconds=0.0,
    )  # fmt: skip
    values = {"psnr": 30.0, "ssim": 0.9, "lpips": 0.1, "alpha_error": 0.02, "alpha_bias": -0.01}
    found = entry.with_scores(scene_scores("a.ply", 9, [ImageScores(**values)]))
    assert {name: getattr(found, name) for name in values} == values


@pytest.mark.slow
def test_the_command_writes_levels(scene, tmp_path, capsys):
    cvtgs.save(scene, tmp_path / "in.ply")
    words = ["levels", str(tmp_path / "in.ply"), "-o", str(tmp_path / "out"), "--rho", "0.1,0.01"]
    assert main([*words, "--views", "2", "--size", "32"]) == 0
    said = json.loads((tmp_path / "out" / "levels.json").read_text())
    assert [level["count"] for level in said["levels"]] == [300, 30]
    assert said["views"] == 2
    assert (said["width"], said["height"]) == (32, 24)
    assert said["levels"][0]["psnr"] > said["levels"][1]["psnr"]
    assert "rho_0.01.ply" in capsys.readouterr().out
    assert main([*words, "--no-scores"]) == 1
    assert "must not exist yet" in capsys.readouterr().err
    assert main([*words, "--no-scores", "--overwrite", "--quiet"]) == 0
    assert main([*words[:-1], "0.1", "--no-scores", "--overwrite"]) == 0
    said = capsys.readouterr().out
    assert "Not in levels.json, of an earlier run: rho_0.01.ply." in said
    with pytest.raises(SystemExit) as ended:
        main([*words[:-1], "0.1,x"])
    assert ended.value.code == 2


def test_boxes_of_levels_are_in_the_axes_of_their_files(tmp_path) -> None:
    levels = Simplifier(device="cpu").levels(random_scene(60), [0.5])
    index = write_levels(levels, tmp_path, rhos=[0.5], source="a", suffix=".glb")
    stored = cvtgs.load(tmp_path / "rho_0.5.glb", axes="rdf").means  # the numbers in the file
    assert list(index.levels[0].box_min) == stored.amin(dim=0).tolist()
    assert list(index.levels[0].box_max) == stored.amax(dim=0).tolist()


def test_the_old_index_goes_before_its_levels_are_replaced(tmp_path, monkeypatch) -> None:
    levels = Simplifier(device="cpu").levels(random_scene(60), [0.5, 0.1])
    write_levels(levels, tmp_path, rhos=[0.5, 0.1], source="a")

    def save(scene, path, **options):
        if len(scene) == 6:
            raise OutputError("the disk is full.")
        cvtgs.save(scene, path, **options)

    monkeypatch.setattr("cvtgs.levels.save", save)
    with pytest.raises(OutputError):
        write_levels(levels, tmp_path, rhos=[0.5, 0.1], source="a", overwrite=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rho_0.1.ply", "rho_0.5.ply"]


def test_a_format_that_cannot_be_read_is_refused_in_capitals_too(tmp_path: Path) -> None:
    with pytest.raises(InvalidArgumentError, match=r"found '\.usda'"):
        check_levels(tmp_path / "out", ["rho_0.1.USDA"])
    assert not (tmp_path / "out").exists()
