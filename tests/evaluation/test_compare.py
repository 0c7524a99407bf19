"""Scores, comparisons, error maps, sheets, pages and photographs."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

import cvtgs
from cvtgs.errors import InputError, InvalidArgumentError
from cvtgs.evaluation import (
    Evaluation,
    EvaluationSettings,
    alpha_bias,
    alpha_error,
    compare,
    comparison_files,
    evaluate,
    fit_cameras,
    load_photographs,
    lpips,
    psnr,
    ssim,
    write_comparison,
)
from cvtgs.evaluation.comparison_files import (
    comparison_page,
    contact_sheet,
    error_sheet,
    render_template,
)
from cvtgs.evaluation.images import (
    ALPHA_SCALE,
    ERROR_SCALE,
    alpha_colors,
    alpha_error_map,
    encode,
    error_map,
    read_image,
)
from cvtgs.evaluation.scorer import Metrics
from cvtgs.rendering import render
from cvtgs.views import automatic_views
from lpips_cases import random_images, random_weights

OFF = EvaluationSettings(lpips="off")
PARTS = ("images", "errors", "alpha_errors")


@pytest.fixture(scope="module")
def scene():
    return cvtgs.synthetic.scene("object", 3000, sh_degree=1, seed=0)


@pytest.fixture(scope="module")
def cameras(scene):
    return automatic_views(scene, 3, width=48, height=36)


@pytest.fixture(scope="module")
def small(scene):
    return {
        rho: cvtgs.Simplifier(device="cpu").simplify(scene, float(rho)) for rho in ("0.1", "0.01")
    }


@pytest.fixture(scope="module")
def comparison(scene, small, cameras):
    return compare(scene, small, cameras, sizes={"full": 123_456, "0.1": 12_345}, settings=OFF)


def test_scores_equal_those_of_the_metrics(scene, small, cameras):
    evaluation = evaluate(scene, small, cameras, settings=OFF)
    truth, image = (render(s, cameras).rgb.clamp(0, 1) for s in (scene, small["0.1"]))
    scores = evaluation.scenes[0]
    assert (scores.name, scores.count) == ("0.1", 300)
    assert scores.psnr.views == pytest.approx(psnr(image, truth).tolist(), rel=1e-5)
    assert scores.ssim.views == pytest.approx(ssim(image, truth).tolist(), rel=1e-5)
    assert scores.psnr.mean == pytest.approx(sum(scores.psnr.views) / 3)
    assert scores.lpips is None
    alpha, true_alpha = (render(s, cameras).alpha for s in (small["0.1"], scene))
    wanted = alpha_error(alpha, true_alpha), alpha_bias(alpha, true_alpha)
    assert scores.alpha_error.views == pytest.approx(wanted[0].tolist(), rel=1e-5)
    assert scores.alpha_bias.views == pytest.approx(wanted[1].tolist(), rel=1e-4)
    assert evaluation.lpips_note == "not asked for"
    assert evaluation.scenes[1].psnr.mean < scores.psnr.mean
    assert evaluation.views == ("view 1", "view 2", "view 3")


def test_the_full_scene_is_rendered_once_per_view(scene, small, cameras, monkeypatch):
    from cvtgs.evaluation import scorer  # noqa: PLC0415 (patched below)

    seen = []

    def counting(scene, camera, **choices):
        seen.append((camera.view_names, len(scene)))
        return render(scene, camera, **choices)

    monkeypatch.setattr(scorer, "render", counting)
    named = replace(cameras, names=("a", "b", "c"))
    evaluate(scene, small, named, settings=OFF)
    assert seen == [((view,), count) for view in "abc" for count in (3000, 300, 30)]


def test_progress_counts_images(scene, small, cameras):
    events = []
    evaluate(scene, small, cameras, settings=OFF, listener=events.append)
    assert [(event.done, event.total) for event in events] == [(k, 9) for k in range(10)]


def test_an_equal_scene_has_infinite_psnr_also_in_json(scene, cameras):
    evaluation = evaluate(scene, {"same": scene}, cameras, settings=OFF)
    assert math.isinf(evaluation.scenes[0].psnr.mean)
    assert evaluation.scenes[0].ssim.mean == pytest.approx(1)
    assert '"mean": "Infinity"' in evaluation.to_json()
    assert Evaluation.model_validate_json(evaluation.to_json()) == evaluation


def test_missing_lpips_weights_are_fatal_only_if_requested(
    scene, small, cameras, monkeypatch, tmp_path
):
    monkeypatch.setenv("CVTGS_LPIPS_WEIGHTS", str(tmp_path))
    evaluation = evaluate(scene, small, cameras)
    assert evaluation.lpips_network is None
    assert "lpips_alex*.pth" in evaluation.lpips_note
    with pytest.raises(cvtgs.errors.InputNotFoundError):
        evaluate(scene, small, cameras, settings=EvaluationSettings(lpips="vgg"))


def test_photographs_are_scored_for_every_scene(scene, small, cameras):
    images = render(scene, cameras).rgb.clamp(0, 1)
    photographs = images * torch.tensor([0.9, 0.92, 0.94])[:, None, None, None]
    evaluation = evaluate(scene, small, cameras, settings=OFF, photographs=photographs)
    assert [scores.name for scores in evaluation.photographs] == ["full", "0.1", "0.01"]
    full, tenth, _ = evaluation.photographs
    assert tenth.alpha_error is None
    assert tenth.alpha_bias is None
    assert tenth.psnr.mean < full.psnr.mean < 40
    assert full.psnr.views == pytest.approx(psnr(images, photographs).tolist(), rel=1e-4)
    with pytest.raises(ValueError, match=r"photographs must be a .*\(3, 36, 48, 3\), found"):
        evaluate(scene, small, cameras, settings=OFF, photographs=photographs[:2])
    refused = [
        ((photographs * 255).byte(), r"a tensor of floats .*, found torch\.uint8"),
        (photographs.numpy(), r"a tensor of floats .*, found ndarray"),
        (photographs * 255, r"must be in \[0, 1\], found values from 0 to"),
        (photographs * math.nan, r"must be in \[0, 1\], found values from nan to nan"),
    ]
    for wrong, message in refused:
        with pytest.raises(InvalidArgumentError, match=message):
            evaluate(scene, small, cameras, settings=OFF, photographs=wrong)


def test_evaluate_refuses_invalid_arguments(scene, cameras):
    for wrong, message in (
        ({"full": scene}, "the name of the full"),
        (scene, "must be a dictionary of scenes by name, such as"),
    ):
        with pytest.raises(InvalidArgumentError, match=message):
            evaluate(scene, wrong, cameras, settings=OFF)
    with pytest.raises(ValueError, match="at least one camera"):
        evaluate(scene, {"a": scene}, cameras.select(torch.tensor([], dtype=torch.long)))
    with pytest.raises(ValueError, match="lpips must be one of auto, vgg, alex, off, found 'x'"):
        EvaluationSettings(lpips="x")


def test_cameras_that_miss_the_scene_are_refused(scene, cameras):
    away = cameras.viewmats.clone()
    away[:, 0, 3] += 1e4  # the scene lies far to the right of every image
    elsewhere, events = replace(cameras, viewmats=away), []
    for score in (evaluate, compare):
        with pytest.raises(ValueError, match=r"must see full, found nothing of it in any of 3"):
            score(scene, {"a": scene}, elsewhere, settings=OFF, listener=events.append)
    assert not events  # refused before anything is scored


@pytest.mark.parametrize("color", [(0.0, 1.0), (math.nan, 0, 0), (2, 0, 0), "white", "red", 1.0])
def test_a_background_that_is_no_color_is_refused(color):
    with pytest.raises(InvalidArgumentError, match=r"must be three numbers in \[0, 1\], found"):
        EvaluationSettings(background=color)


def test_a_background_may_be_a_tensor():
    settings = EvaluationSettings(background=torch.ones(3))
    assert settings == EvaluationSettings(background=(1.0, 1.0, 1.0))


def test_the_background_shows_through(scene, small, cameras):
    settings = EvaluationSettings(lpips="off", background=(1.0, 1.0, 1.0))
    white = compare(scene, small, cameras, settings=settings)
    black = compare(scene, small, cameras, settings=OFF)
    gains = white.full.colors.astype(int) - black.full.colors.astype(int)
    assert gains.min() >= 0
    assert gains.max() > 10
    assert (white.full.alphas == black.full.alphas).all()
    for one, other in zip(white.evaluation.scenes, black.evaluation.scenes, strict=True):
        assert one.psnr != other.psnr
        assert one.alpha_error == other.alpha_error


def test_photographs_are_found_by_stem_suffix_and_last_part(tmp_path, cameras):
    names = ("train/a", "b.jpg", "images/c.png")
    named = cvtgs.Cameras(
        viewmats=cameras.viewmats, Ks=cameras.Ks, width=48, height=36, names=names
    )
    (tmp_path / "images").mkdir()
    for value, path in ((50, "a.PNG"), (100, "b.png"), (150, "images/c.png"), (9, "a_mask.png")):
        (tmp_path / path).write_bytes(encode(np.full((72, 96, 3), value, np.uint8), "png"))
    photographs = load_photographs(tmp_path, named)
    assert photographs.shape == (3, 36, 48, 3)
    assert (photographs[:, 18, 24, 0] * 255).round().tolist() == [50, 100, 150]


def test_cameras_of_the_same_name_share_a_photograph(tmp_path, cameras):
    twice = cvtgs.Cameras(
        viewmats=cameras.viewmats[:2], Ks=cameras.Ks[:2], width=48, height=36, names=("a", "a")
    )
    (tmp_path / "a.png").write_bytes(encode(np.full((36, 48, 3), 50, np.uint8), "png"))
    assert load_photographs(tmp_path, twice).shape == (2, 36, 48, 3)


def test_transparent_pixels_show_the_background(tmp_path, cameras):
    from PIL import Image  # noqa: PLC0415

    one = cvtgs.Cameras(
        viewmats=cameras.viewmats[:1], Ks=cameras.Ks[:1], width=48, height=36, names=("a",)
    )
    Image.new("RGBA", (48, 36), (255, 0, 0, 0)).save(tmp_path / "a.png")
    assert load_photographs(tmp_path, one, background=(0.0, 0.5, 1.0))[0, 5, 5].tolist() == [
        0.0,
        0.5,
        1.0,
    ]


def test_missing_and_damaged_photographs_are_named(tmp_path, cameras):
    with pytest.raises(FileNotFoundError, match="3 of 3 cameras have none, the first is 'view 1'"):
        load_photographs(tmp_path, cameras)
    with pytest.raises(FileNotFoundError, match="the folder of photographs must exist"):
        load_photographs(tmp_path / "nowhere", cameras)
    for number in (1, 2, 3):
        (tmp_path / f"view {number}.png").write_bytes(b"no image")
    with pytest.raises(cvtgs.errors.FileFormatError, match=r"view 1\.png: must be an image"):
        load_photographs(tmp_path, cameras)
    content = encode(np.zeros((36, 48, 3), np.uint8), "png")
    (tmp_path / "view 1.png").write_bytes(content[: len(content) // 2])
    with pytest.raises(cvtgs.errors.FileFormatError, match="must be a whole image"):
        load_photographs(tmp_path, cameras)


def test_each_photograph_must_have_the_shape_of_its_own_camera(tmp_path, cameras):
    """A camera with images of its own size has been stretched to the size of the others."""
    intrinsics = cameras.Ks.clone()
    intrinsics[1, 1, 1] *= 2.0  # its own images are twice as wide
    mixed = cvtgs.Cameras(
        viewmats=cameras.viewmats, Ks=intrinsics, width=48, height=36, names=("a", "b", "c")
    )
    for name, size in (("a", (18, 24)), ("b", (18, 48)), ("c", (18, 24))):
        (tmp_path / f"{name}.png").write_bytes(encode(np.zeros((*size, 3), np.uint8), "png"))
    fitted = fit_cameras(mixed, tmp_path)
    assert (fitted.width, fitted.height) == (24, 18)
    (tmp_path / "c.png").write_bytes(encode(np.zeros((24, 18, 3), np.uint8), "png"))  # upright
    with pytest.raises(InvalidArgumentError, match=r"c\.png: .* 48 x 36, found 18 x 24"):
        fit_cameras(mixed, tmp_path)


def test_error_maps_grow_brighter_with_the_error():
    black = np.zeros((1, 4, 3), np.uint8)
    other = np.array([[[0] * 3, [20] * 3, [60] * 3, [255] * 3]], np.uint8)
    brightness = error_map(black, other).astype(int).sum(axis=2)[0]
    assert (np.diff(brightness) > 0).all()
    limit = np.full((1, 1, 3), round(255 * ERROR_SCALE), np.uint8)
    assert error_map(black[:, :1], limit).tolist()[0][0] == pytest.approx([252, 253, 191], abs=6)


def test_alpha_maps_are_warm_for_more_background_and_cold_for_less():
    full = np.full((1, 3), 100, np.uint8)
    holes, equal, cover = alpha_error_map(full, np.array([[75, 100, 125]], np.uint8))[0].astype(int)
    assert holes[0] > holes[2] + 100
    assert cover[2] > cover[0] + 100
    assert equal.max() < 10
    ends = np.array([[-ALPHA_SCALE, -1.0, ALPHA_SCALE]], np.float32)
    assert alpha_colors(ends)[0].tolist() == [[255, 246, 205], [255, 246, 205], [214, 240, 255]]


def test_all_views_are_scored_even_if_few_images_are_kept(scene, small, cameras):
    names = ("a", "b", "c")
    few = compare(scene, small, replace(cameras, names=names), most_images=2, settings=OFF)
    assert few.evaluation == evaluate(scene, small, replace(cameras, names=names), settings=OFF)
    assert (few.shown, few.views) == ((0, 1), ("a", "b"))
    assert few.full.colors.shape == (2, 36, 48, 3)
    assert few.small["0.1"].alphas.shape == (2, 36, 48)
    data = data_of(comparison_page(few))
    assert (data["views"], data["shown"], data["scored"]) == (["a", "b"], [0, 1], 3)
    with pytest.raises(ValueError, match="most_images must be a whole number above 0"):
        compare(scene, small, cameras, most_images=0, settings=OFF)


def test_captions_are_those_of_the_shown_views(comparison):
    scores = comparison.evaluation.scenes[0]
    row = vars(comparison_files)["_small_row"](replace(comparison, shown=(2, 0)), scores, None)
    views = scores.psnr.views
    assert row.captions == [f"{views[2]:.2f} dB", f"{views[0]:.2f} dB"]


@pytest.mark.long
def test_sheets_hold_every_image(comparison):
    sheet, errors = contact_sheet(comparison), error_sheet(comparison)
    full, tenth = comparison.full.alphas[2], comparison.small["0.1"].alphas[2]
    wanted = alpha_error_map(full, tenth)
    windows = np.lib.stride_tricks.sliding_window_view(errors, wanted.shape)[:, :, 0]
    assert (windows == wanted).all(axis=(2, 3, 4)).any()
    assert sheet.dtype == errors.dtype == np.uint8
    full = comparison.full.colors[1]
    windows = np.lib.stride_tricks.sliding_window_view(sheet, full.shape)[:, :, 0]
    assert (windows == full).all(axis=(2, 3, 4)).any()
    assert errors.shape[1] >= sheet.shape[1]


def data_of(page: str) -> dict:
    return json.loads(re.search(r'id="data">(.*?)</script>', page, re.DOTALL).group(1))


def test_the_page_is_self_contained(comparison):
    page = comparison_page(comparison)
    data = data_of(page)
    assert data["reference"] == {"name": "full", "count": 3000, "bytes": 123_456}
    assert [scene["count"] for scene in data["small"]] == [300, 30]
    assert [scene["bytes"] for scene in data["small"]] == [12_345, None]
    assert all(len(scene[part]) == 3 for scene in data["small"] for part in PARTS)
    without_images = re.sub(r"data:image/webp;base64,[\w+/=]+", "", page)
    assert not re.search(r"(https?:)?//[a-z]|src=|@import|url\(|fetch\(|XMLHttp", without_images)
    assert "{{" not in without_images


def test_hostile_names_are_escaped(scene, cameras):
    name = '</script><b onclick="x">{{ script }}'
    page = comparison_page(
        compare(scene, {name: scene}, cameras, reference_name="<i>&", settings=OFF)
    )
    assert "</script><b" not in page
    assert "<title>&lt;i&gt;&amp;" in page
    data = data_of(page)
    assert data["small"][0]["name"] == name
    assert data["small"][0]["psnr"]["mean"] == "Infinity"


def test_a_size_limit_makes_the_page_smaller(comparison):
    large, tight = comparison_page(comparison), comparison_page(comparison, most_bytes=1)
    assert len(tight) < len(large)


def test_files_are_replaced_only_with_overwrite(comparison, tmp_path):
    folder = tmp_path / "new" / "page"
    paths = write_comparison(comparison, folder)
    assert sorted(path.name for path in folder.iterdir()) == [
        "errors.png",
        "index.html",
        "sheet.png",
    ]
    first = paths[-1].read_bytes()
    with pytest.raises(FileExistsError, match=r"index\.html.*--overwrite"):
        write_comparison(comparison, folder)
    write_comparison(comparison, folder, overwrite=True)
    assert paths[-1].read_bytes() == first
    (tmp_path / "file").write_text("")
    with pytest.raises(cvtgs.errors.OutputError, match="must be a folder or a new path"):
        write_comparison(comparison, tmp_path / "file" / "page")


def test_lpips_is_added_if_there_are_weights():
    weights = random_weights("alex")
    image, truth = random_images(64, 64)
    found = Metrics(lpips=weights).compare(image, truth)
    wanted = lpips(image, truth, network="alex", weights=weights)
    assert found == Metrics().compare(image, truth)._replace(lpips=float(wanted))


def test_templates_escape_their_values():
    assert render_template("<b>{{ name }}</b>", name="<i>&'\"") == (
        "<b>&lt;i&gt;&amp;&#39;&#34;</b>"
    )
    shown = render_template("{{ data | tojson }}", data={"name": "</script>&"})
    assert "<" not in shown
    assert json.loads(shown) == {"name": "</script>&"}


def test_photographs_need_named_cameras(tmp_path):
    camera = cvtgs.Cameras(viewmats=torch.eye(4)[None], Ks=torch.eye(3)[None], width=4, height=3)
    with pytest.raises(InvalidArgumentError, match="matched by the names of the cameras"):
        load_photographs(tmp_path, camera)


def test_an_unreadable_photograph_is_an_error(tmp_path):
    with pytest.raises(InputError, match="the file must be readable, found: is a directory"):
        read_image(tmp_path, (4, 3), (0.0, 0.0, 0.0))
