"""Photographs that are matched to cameras by name."""

import weakref
from dataclasses import replace

import numpy as np
import pytest
import torch

import cvtgs
from cvtgs.errors import FileFormatError, InvalidArgumentError
from cvtgs.evaluation import EvaluationSettings, fit_cameras, load_photographs
from cvtgs.evaluation.images import Photographs, encode, read_image


def rig_of(*names: str) -> cvtgs.Cameras:
    count = len(names)
    viewmats, Ks = torch.eye(4).expand(count, 4, 4), torch.eye(3).expand(count, 3, 3)  # noqa: N806
    return cvtgs.Cameras(viewmats=viewmats, Ks=Ks, width=48, height=36, names=names)


def test_a_photograph_of_two_cameras_is_an_error(tmp_path):
    """The folder is that of the left camera; its images have the same names as the right ones."""
    rig = rig_of("left/1.png", "right/1.png")
    content = encode(np.full((36, 48, 3), 50, np.uint8), "png")
    (tmp_path / "1.png").write_bytes(content)
    for use in (lambda: load_photographs(tmp_path, rig), lambda: fit_cameras(rig, tmp_path)):
        with pytest.raises(InvalidArgumentError) as caught:
            use()
        assert str(caught.value) == (
            f"{tmp_path}: every camera must have its own photograph, but 'left/1.png' and "
            f"'right/1.png' both match 1.png; give the folder that holds the folders in these "
            f"names."
        )
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        (tmp_path / side / "1.png").write_bytes(content)
    assert load_photographs(tmp_path, rig).shape == (2, 36, 48, 3)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_grey_of_16_bits_is_that_of_8(suffix, tmp_path):
    from PIL import Image  # noqa: PLC0415

    values = np.arange(0, 256, dtype=np.uint8).reshape(16, 16)
    one = cvtgs.Cameras(
        viewmats=torch.eye(4)[None], Ks=torch.eye(3)[None], width=16, height=16, names=("a",)
    )
    for nearly in (-128, 0, 128):  # rounds to the same eight bits
        grey = (values.astype(np.int64) * 257 + nearly).clip(0, 65535).astype(np.uint16)
        Image.fromarray(grey).save(tmp_path / f"a{suffix}")
        found = load_photographs(tmp_path, one)[0]
        for channel in range(3):
            assert (found[:, :, channel] * 255).round().byte().numpy().tolist() == values.tolist()


@pytest.mark.parametrize("name", ["a.jpg", "a.JPG", "a.jpeg", "images/a.Jpeg"])
def test_a_mask_of_another_format_is_no_photograph(tmp_path, name):
    for suffix, value in ((".png", 0), (".jpg", 255)):
        content = encode(np.full((36, 48, 3), value, np.uint8), "png")
        (tmp_path / f"a{suffix}").write_bytes(content)
    assert float(load_photographs(tmp_path, rig_of(name)).mean()) == 1.0


def test_two_formats_of_which_none_is_that_of_the_name_are_an_error(tmp_path):
    content = encode(np.zeros((36, 48, 3), np.uint8), "png")
    (tmp_path / "a.png").write_bytes(content)
    for name in ("a", "a.HEIC", "a.tif"):
        assert load_photographs(tmp_path, rig_of(name)).shape == (1, 36, 48, 3)
    (tmp_path / "a.jpg").write_bytes(content)
    for name in ("a", "a.HEIC", "a.tif"):
        with pytest.raises(InvalidArgumentError) as caught:
            load_photographs(tmp_path, rig_of(name))
        wanted = f"{tmp_path}: must hold one photograph of camera {name!r}, found a.png and a.jpg."
        assert str(caught.value) == wanted


def test_a_suffix_may_start_with_a_capital(tmp_path):
    one = cvtgs.Cameras(
        viewmats=torch.eye(4)[None], Ks=torch.eye(3)[None], width=8, height=8, names=("a.jpg",)
    )
    (tmp_path / "a.Jpg").write_bytes(encode(np.zeros((8, 8, 3), np.uint8), "png"))
    assert load_photographs(tmp_path, one).shape == (1, 8, 8, 3)


@pytest.mark.parametrize(
    ("dtype", "kind"), [(np.float32, "floats"), (np.int32, "integers of 32 bits")]
)
def test_images_whose_white_is_unknown_are_refused(tmp_path, dtype, kind):
    from PIL import Image  # noqa: PLC0415

    Image.fromarray(np.full((16, 16), 1, dtype=dtype)).save(tmp_path / "a.tif")
    with pytest.raises(FileFormatError, match=rf"a\.tif: must have 8 or 16 bits.*, found {kind}"):
        read_image(tmp_path / "a.tif", (16, 16), (0.0, 0.0, 0.0))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_the_transparent_value_of_a_grey_image_shows_the_background(tmp_path, dtype):
    from PIL import Image  # noqa: PLC0415

    white = int(np.iinfo(dtype).max)
    values = np.zeros((8, 8), dtype=dtype)
    values[:, 4:] = white
    try:
        Image.fromarray(values).save(tmp_path / "a.png", transparency=white)
    except OSError:
        pytest.skip("this Pillow writes no transparent value of 16 bits")
    found = read_image(tmp_path / "a.png", (8, 8), (0.0, 1.0, 0.5))
    assert found[:, :4].max() == 0.0
    assert found[0, 7].tolist() == [0.0, 1.0, 0.5]


def test_upright_photographs_may_have_pixels_that_are_not_quite_square(tmp_path):
    """The second camera was stretched from 120 x 160 to 160 x 120 pixels, with fy = 1.002 fx."""
    first = torch.tensor([[150.0, 0, 80], [0, 150.3, 60], [0, 0, 1]])
    second = torch.tensor([[200.0, 0, 80], [0, 112.725, 60], [0, 0, 1]])
    cameras = cvtgs.Cameras(
        viewmats=torch.eye(4).expand(2, 4, 4),
        Ks=torch.stack([first, second]) * torch.tensor([10.0, 10.0, 1.0])[:, None],
        width=1600,
        height=1200,
        names=("a", "b"),
    )
    for name, size in (("a", (1200, 1600)), ("b", (1600, 1200))):
        (tmp_path / f"{name}.png").write_bytes(encode(np.zeros((*size, 3), np.uint8), "png"))
    assert fit_cameras(cameras, tmp_path) is cameras
    (tmp_path / "b.png").write_bytes(encode(np.zeros((1600, 1100, 3), np.uint8), "png"))
    with pytest.raises(InvalidArgumentError, match="found 1100 x 1600"):
        fit_cameras(cameras, tmp_path)


def test_a_photograph_lies_in_the_folder_by_any_last_parts_of_its_name(tmp_path):
    """As of a rig whose names begin with a folder that was scaled: images/left/1.png."""
    rig = rig_of("images/left/1.png", "images/right/1.png")
    for value, side in ((50, "left"), (100, "right")):
        (tmp_path / "images_4" / side).mkdir(parents=True)
        content = encode(np.full((36, 48, 3), value, np.uint8), "png")
        (tmp_path / "images_4" / side / "1.png").write_bytes(content)
    found = load_photographs(tmp_path / "images_4", rig)
    assert (found[:, 0, 0, 0] * 255).round().tolist() == [50, 100]


def test_an_image_of_too_many_pixels_is_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setattr("PIL.Image.MAX_IMAGE_PIXELS", 20)
    (tmp_path / "a.png").write_bytes(encode(np.zeros((8, 8, 3), np.uint8), "png"))
    with pytest.raises(FileFormatError, match=r"a\.png: must have fewer pixels; Image size \(64"):
        read_image(tmp_path / "a.png", (8, 8), (0.0, 0.0, 0.0))


def test_evaluate_reads_photographs_one_by_one(tmp_path, monkeypatch):
    """Read at once, 300 photographs of 1,600 x 1,200 pixels would take 7 GB."""
    names, read, alive = tuple(f"{number}.png" for number in range(6)), [], []
    for name in names:
        (tmp_path / name).write_bytes(encode(np.full((36, 48, 3), 50, np.uint8), "png"))
    scene = cvtgs.synthetic.scene("object", 200, sh_degree=0, seed=0)
    views = cvtgs.views.automatic_views(scene, 6, width=48, height=36)
    rig = replace(views, names=names)

    def note(*args: object) -> np.ndarray:
        image = read_image(*args)
        alive.append(sum(one() is not None for one in read))
        read.append(weakref.ref(image))
        return image

    settings = EvaluationSettings(lpips="off")
    whole = load_photographs(tmp_path, rig)
    expected = cvtgs.evaluate(scene, {"a": scene}, rig, photographs=whole, settings=settings)
    monkeypatch.setattr("cvtgs.evaluation.images.read_image", note)
    lazy = Photographs(tmp_path, rig, background=(0.0, 0.0, 0.0))
    found = cvtgs.evaluate(scene, {"a": scene}, rig, photographs=lazy, settings=settings)
    assert found == expected
    assert len(alive) == 6
    assert max(alive) <= 2
