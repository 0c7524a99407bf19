"""Protected regions: kept bit for bit, counted, and an error if they do not fit the target."""

import codecs
import json
import pickle
import re
from pathlib import Path

import pytest
import torch

import cvtgs
from cvtgs import Simplifier, SimplifyConfig
from cvtgs.boxes import Box, Sphere, inside, read_boxes
from cvtgs.cli.main import main
from cvtgs.errors import InputNotFoundError, InvalidArgumentError
from cvtgs.refinement import refine
from scenes import random_scene, same_bits

EACH = pytest.mark.parametrize("preset", ["standard", "paper", "draft"])


@pytest.fixture(scope="module")
def scene():
    return random_scene(400, degree=1)


@EACH
@pytest.mark.parametrize("kept", [0, 1, 39, 40])
def test_kept_rows_come_first_with_unchanged_bits(scene, preset, kept):
    keep = torch.zeros(400, dtype=torch.bool)
    keep[torch.randperm(400, generator=torch.Generator().manual_seed(1))[:kept]] = True
    small, report = Simplifier(config=preset, device="cpu").run(scene, count=41, keep=keep)
    assert len(small) == report.output_count == 41
    assert report.kept_count == kept
    assert same_bits(small.select(torch.arange(kept)), scene.select(keep))


def test_an_empty_mask_gives_the_same_bits_as_no_mask(scene):
    simplifier = Simplifier(device="cpu")
    nothing = torch.zeros(400, dtype=torch.bool)
    assert same_bits(simplifier.simplify(scene, 0.1, keep=nothing), simplifier.simplify(scene, 0.1))


def test_the_target_must_exceed_the_kept_rows(scene):
    keep = torch.arange(400) < 40
    with pytest.raises(InvalidArgumentError, match=r"so the target must be at least 41 of the 400"):
        Simplifier(device="cpu").simplify(scene, 0.1, keep=keep)


def test_a_ratio_of_one_keeps_all_rows_and_kept_ones_come_first(scene):
    keep = torch.arange(400) >= 390
    small = Simplifier(device="cpu").simplify(scene, 1.0, keep=keep)
    assert same_bits(small.select(torch.arange(10)), scene.select(keep))
    assert len(small) == 400


@pytest.mark.parametrize(
    "mask",
    [torch.ones(3, dtype=torch.bool), torch.ones(400), [1] * 400, "all", [[True], [True, False]]],
)
def test_masks_that_do_not_fit_are_refused(scene, mask):
    with pytest.raises(InvalidArgumentError, match=r"keep must be a boolean tensor of shape.*\.$"):
        Simplifier(device="cpu").simplify(scene, 0.1, keep=mask)


def test_masks_may_be_arrays_and_lists(scene):
    mask = torch.arange(400) >= 390
    wanted = Simplifier(device="cpu").simplify(scene, 0.1, keep=mask)
    read_only = mask.numpy().copy()
    read_only.flags.writeable = False
    for alike in (read_only, mask.flip(0).numpy()[::-1], mask.tolist()):
        assert same_bits(Simplifier(device="cpu").simplify(scene, 0.1, keep=alike), wanted)


def test_invalid_rows_are_never_kept(scene):
    means = scene.means.clone()
    means[0] = torch.nan
    keep = torch.arange(400) < 5
    with pytest.warns(UserWarning, match="dropped 1 of 400"):
        small, report = Simplifier(device="cpu").run(
            scene.with_tensors({"means": means}, {}), 0.1, keep=keep
        )
    assert (len(small), report.kept_count) == (40, 4)
    assert same_bits(small.select(torch.arange(4)), scene.select(torch.arange(1, 5)))


def test_invalid_rows_leave_the_others_in_standard_form(scene):
    means = scene.means.clone()
    means[0] = torch.nan
    scene = scene.with_tensors({"means": means, "quats": 5 * scene.quats}, {})
    keep = torch.arange(400) == 3
    with pytest.warns(UserWarning, match="dropped 1 of 400"):
        small = Simplifier(device="cpu").simplify(scene, count=399, keep=keep)
    assert same_bits(small.select(torch.arange(1)), scene.select(torch.tensor([3])))
    norms = torch.linalg.vector_norm(small.quats[1:], dim=1)
    torch.testing.assert_close(norms, torch.ones(398))


@pytest.mark.slow
def test_refinement_leaves_kept_rows_alone(scene):
    keep = torch.arange(400) < 30
    config = SimplifyConfig.from_mapping({"refine": {"steps": 2, "size": 32, "heldout": 2}})
    small = Simplifier(config=config, device="cpu").simplify(scene, 0.2, keep=keep)
    assert same_bits(small.select(torch.arange(30)), scene.select(keep))


@pytest.mark.slow
def test_refinement_leaves_unused_bands_at_zero():
    """Those of protected Gaussians, which are too faint to count, stay bit for bit."""
    scene = random_scene(400, degree=2)
    bands = scene.shN.clone()
    bands[:, 3:] *= 1e-7
    scene = scene.with_tensors({"shN": bands}, {})
    config = SimplifyConfig.from_mapping({"refine": {"steps": 4, "size": 32, "heldout": 2}})
    small, report = Simplifier(config=config, device="cpu").run(
        scene, 0.2, keep=torch.arange(400) < 30
    )
    assert report.plan.sh.degree == 1
    assert report.refinement.changed_count > 0
    assert same_bits(small[:30], scene[:30])
    assert not bool(small.shN[30:, 3:].any())


@pytest.mark.slow
@pytest.mark.parametrize("stride", [1, 2])
def test_refinement_is_told_what_to_keep_and_reuses_only_images_of_its_kind(
    scene, monkeypatch, stride
):
    told = []

    def noted(small, full, **words):
        told.append((words["frozen"], words["observed"] is not None))
        return refine(small, full, **words)

    monkeypatch.setattr("cvtgs.refinement.refine", noted)
    config = SimplifyConfig.from_mapping({
        "preset": "matched",
        "visibility": {"views": 8, "size": 32, "stride": 1},
        "match": {"color_iterations": 1},
        "refine": {"steps": 1, "size": 32, "heldout": 1, "stride": stride},
    })  # fmt: skip
    Simplifier(config=config, device="cpu").simplify(scene, 0.2, keep=torch.arange(400) < 30)
    assert told == [(30, stride == 1)]


def test_boxes_include_their_faces():
    box = Box(min=(0, 0, 0), max=(1, 1, 1))
    points = torch.tensor([[0.0, 0, 0], [1, 1, 1], [1.0001, 0, 0], [-1, 0, 0]])
    assert inside([box], points).tolist() == [True, True, False, False]
    assert inside([], points).tolist() == [False] * 4
    assert inside(box, points).tolist() == [True, True, False, False]
    ball = Sphere(center=(-1, 0, 0), radius=1)
    assert inside([ball, Box(min=(1, 1, 1), max=(1, 1, 1))], points).tolist() == [1, 1, 0, 1]


@pytest.mark.parametrize(
    ("boxes", "points", "text"),
    [
        (None, torch.zeros(2, 3), "regions must be boxes or spheres, found None."),
        ([(0, 1)], torch.zeros(2, 3), "regions must be boxes or spheres, found (0, 1)."),
        ([], torch.zeros(2, 2), "means must be a tensor of floats of shape (n, 3), found "
         "torch.float32 of shape (2, 2)."),
        ([], torch.zeros(2, 3).numpy(), "floats of shape (n, 3), found ndarray."),
        ([], torch.zeros(2, 3).int(), "found torch.int32 of shape (2, 3)."),
    ],
)  # fmt: skip
def test_boxes_and_centres_are_checked(boxes, points, text):
    with pytest.raises(InvalidArgumentError, match=re.escape(text)):
        inside(boxes, points)


def test_a_point_may_be_in_any_of_several_boxes_which_may_be_flat() -> None:
    flat, second = Box(min=(0, 0, 0), max=(1, 1, 0)), Box(min=(2, 2, 2), max=(3, 3, 3))
    points = torch.tensor([[0.5, 0.5, 0.0], [2.5, 2.5, 2.5], [0.5, 0.5, 2.5]])
    assert inside([flat, second], points).tolist() == [True, True, False]


@pytest.mark.parametrize("corners", [{"min": (1, 0, 0), "max": (0, 0, 0)}, {"min": (0, 0)}, {}])
def test_bad_boxes_are_refused(corners):
    with pytest.raises(InvalidArgumentError, match="a box must have a min and a max of three"):
        Box(**corners)
    box = Box(min=(0, 0, 0), max=(1, 1, 1))
    assert pickle.loads(pickle.dumps(box)) == Box.model_validate_json(box.model_dump_json()) == box


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("nothing", "must be valid JSON"),
        ("[]", "at least one box"),
        (100_000 * "[", "must be valid JSON"),
        ('{"min": [0, 0, 0]}', "max: field required"),
        ('{"min": [0, 0, 2], "max": [1, 1, 1]}', "min must not be above max"),
        ('{"min": [0, 0], "max": [1, 1, 1]}', "min.2"),
        ('{"min": [0, 0, NaN], "max": [1, 1, 1]}', "finite"),
    ],
)
def test_bad_box_files_say_what_is_wrong(tmp_path, text, problem):
    path = tmp_path / "box.json"
    path.write_text(text)
    with pytest.raises(InvalidArgumentError, match=problem):
        read_boxes(path)
    with pytest.raises(InputNotFoundError):
        read_boxes(tmp_path / "none.json")


def test_box_files_may_begin_with_a_byte_order_mark(tmp_path: Path) -> None:
    path = tmp_path / "box.json"
    path.write_bytes(codecs.BOM_UTF8 + b'{"min": [0, 0, 0], "max": [1, 2, 3]}')
    assert read_boxes(path) == (Box(min=(0, 0, 0), max=(1, 2, 3)),)


def test_the_command_keeps_the_gaussians_in_boxes(scene, tmp_path):
    cvtgs.save(scene, tmp_path / "in.ply")
    box = {"min": [0.5, -9, -9], "max": [9, 9, 9]}
    (tmp_path / "box.json").write_text(json.dumps([box, box]))
    words = ["simplify", str(tmp_path / "in.ply"), str(tmp_path / "out.ply"), "--quiet"]
    words += ["--keep", str(tmp_path / "box.json")]
    assert main([*words, "--rho", "0.5"]) == 0
    kept = scene.select(scene.means[:, 0] >= 0.5)
    small = cvtgs.load(tmp_path / "out.ply")
    assert len(small) == 200
    assert same_bits(small.select(torch.arange(len(kept))), kept)
    assert main([*words, "--rho", "0.01", "--overwrite"]) == 1


def test_a_ratio_of_one_with_kept_rows_changes_no_bits():
    scene = random_scene(40, degree=1)
    scene = scene.with_tensors({"quats": 5 * scene.quats}, {})
    small = Simplifier(device="cpu").simplify(scene, 1.0, keep=torch.arange(40) >= 30)
    assert same_bits(small, scene.select(torch.cat([torch.arange(30, 40), torch.arange(30)])))
