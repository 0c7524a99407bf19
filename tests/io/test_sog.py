"""SOG files: bundled and unbundled, version 1 and 2."""

import io
import json
import math
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st

from cvtgs import load, save
from cvtgs.errors import FileFormatError, InputNotFoundError
from cvtgs.io.sog.write import codebook, encode_webp, palette, palette_size, write_sog
from format_cases import (
    DATA,
    assert_as_oracle,
    assert_within,
    nearest_rows,
    refusal,
    storable_scene,
)
from format_oracles import read_sog

THEIRS = DATA / "splat-transform.sog"


def unpacked(folder: Path, source: Path = THEIRS) -> Path:
    """Unpack a bundle; return its meta.json."""
    with zipfile.ZipFile(source) as archive:
        archive.extractall(folder)
    return folder / "meta.json"


def changed(folder: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """Unpack the bundle and change its meta.json."""
    path = unpacked(folder)
    meta = json.loads(path.read_text())
    change(meta)
    path.write_text(json.dumps(meta))
    return path


def test_a_file_of_splat_transform_is_read() -> None:
    scene, source = load(THEIRS), load(DATA / "source.ply")
    assert_as_oracle(scene, read_sog(THEIRS))
    assert scene.comments == ("SplatRenderMode: mip",)
    assert scene.sh_degree == 1
    bounds = {"means": 2e-3, "log_scales": 0.02, "opacities": 1 / 255, "sh0": 0.05, "angle": 0.03}
    assert_within(source, nearest_rows(source, scene), bounds)


def test_an_unbundled_sog_is_read_by_file_and_by_folder(tmp_path: Path) -> None:
    path, scene = unpacked(tmp_path), load(THEIRS)
    for source in (path, tmp_path):
        for name, tensor in load(source).tensors().items():
            assert torch.equal(tensor, scene.tensors()[name])


@pytest.mark.parametrize("name", ["scene-meta.json", "META.JSON"])
def test_the_index_of_an_unbundled_sog_may_have_another_name(tmp_path: Path, name: str) -> None:
    path = unpacked(tmp_path)
    other = path.rename(tmp_path / name)
    assert torch.equal(load(other).means, load(THEIRS).means)


def image(rows: list[list[int]]) -> bytes:
    return encode_webp(np.array(rows, np.uint8).reshape(1, -1, 4))


def test_a_file_of_version_1_made_by_hand_is_read(tmp_path: Path) -> None:
    """Two Gaussians; values are in equal steps between a minimum and a maximum."""
    meta = {
        "means": {
            "shape": [2, 3], "mins": [0, 0, -math.log(3)], "maxs": [math.log(2), 1, 0],
            "files": ["l.webp", "u.webp"],
        },
        "scales": {"shape": [2, 3], "mins": [-5, -4, -3], "maxs": [0, 0, 0], "files": ["s.webp"]},
        "quats": {"shape": [2, 4], "files": ["q.webp"]},
        "sh0": {"mins": [-1, -1, -1, -4], "maxs": [1, 1, 1, 4], "files": ["c.webp"]},
        "shN": {"mins": -2, "maxs": 2, "files": ["p.webp", "i.webp"]},
    }  # fmt: skip
    (tmp_path / "meta.json").write_text(json.dumps(meta))
    files = {
        "l": [[255, 0, 0, 255], [0, 0, 255, 255]],
        "u": [[255, 0, 0, 255], [0, 0, 255, 255]],
        "s": [[255, 0, 255, 255], [0, 255, 0, 255]],
        "q": [[128, 128, 128, 253], [1, 2, 3, 7]],  # half a turn about x; no rotation
        "c": [[255, 0, 0, 255], [0, 255, 0, 0]],
        "i": [[1, 0, 0, 255], [64, 0, 0, 255]],  # of 64 colours, so the second has none
    }
    for name, rows in files.items():
        (tmp_path / f"{name}.webp").write_bytes(image(rows))
    pixels = np.zeros((1, 192, 4), np.uint8)
    pixels[0, 3:6, 0] = 255
    (tmp_path / "p.webp").write_bytes(encode_webp(pixels))
    scene = load(tmp_path)
    torch.testing.assert_close(scene.means, torch.tensor([[1.0, 0, -2], [0, 0, 0]]))
    torch.testing.assert_close(scene.log_scales, torch.tensor([[0.0, -4, 0], [-5, 0, -3]]))
    assert scene.logit_opacities.tolist() == [4, -4]
    assert scene.sh0[:, 0].tolist() == [[1, -1, -1], [-1, 1, -1]]
    assert scene.shN.tolist() == [[[2, -2, -2]] * 3, [[0, 0, 0]] * 3]
    half_turn = torch.tensor([[0.0, 1, 0, 0], [1, 0, 0, 0]])
    torch.testing.assert_close(scene.quats, half_turn, rtol=0, atol=3e-3)


@settings(max_examples=15, deadline=None)
@given(count=st.integers(1, 80), seed=st.integers(0, 1000), degree=st.integers(0, 3))
def test_round_trip(
    tmp_path_factory: pytest.TempPathFactory, count: int, seed: int, degree: int
) -> None:
    path = tmp_path_factory.mktemp("sog") / "a.sog"
    scene = storable_scene(count, seed=seed, degree=degree)
    save(scene, path)
    again = load(path)
    assert_as_oracle(again, read_sog(path))
    bounds = {
        "means": 1e-3,
        "log_scales": 0.03,
        "opacities": 0.5 / 255 + 1e-6,
        "sh0": 0.03,
        "shN": 0.02,
        "angle": 0.02,
    }
    assert_within(scene, nearest_rows(scene, again), bounds)
    assert again.antialiased


def test_the_same_scene_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.sog", "b.sog"):
        save(storable_scene(50), tmp_path / name)
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()


def test_faint_gaussians_keep_their_colour(tmp_path: Path) -> None:
    """The encoder must not make pixels of opacity 0 black."""
    scene = storable_scene(20, degree=0)
    hidden = scene.with_tensors({"logit_opacities": scene.logit_opacities * 0 - 30}, {})
    save(hidden, tmp_path / "a.sog")
    again = nearest_rows(scene, load(tmp_path / "a.sog"))
    assert_within(scene, again, {"sh0": 0.03})


def test_the_codebook_is_better_than_uniform_steps() -> None:
    rng = np.random.default_rng(0)
    values = np.append(rng.normal(size=(5000, 3)), [[9.0, -9, 30]], axis=0)
    codes, labels = codebook(values)
    assert codes.shape == (256,)
    assert np.all(np.diff(codes) >= 0)
    error = np.abs(codes[labels] - values)
    assert error.max() < 0.3
    uniform = np.linspace(-9, 30, 256)
    coarse = np.abs(uniform[:, None] - values.ravel()).min(axis=0)
    assert np.square(error).mean() < 0.05 * np.square(coarse).mean()


@pytest.mark.parametrize("values", [np.zeros((3, 3)), np.array([[1.0, 2.0, 2.0]])])
def test_the_codebook_keeps_few_values_exactly(values: np.ndarray) -> None:
    codes, labels = codebook(values)
    assert np.array_equal(codes[labels], values)


@pytest.mark.parametrize("outlier", [30.0, 1e4, 1e10, -1e18, 3e38])
def test_an_outlier_does_not_coarsen_other_values(outlier: float) -> None:
    values = np.random.default_rng(0).normal(size=5000).astype(np.float32)
    wanted = codebook(values)
    values[0] = outlier
    codes, labels = codebook(values)
    near = np.square((codes[labels] - values)[1:]).mean()
    assert near < 1.2 * np.square((wanted.codes[wanted.labels] - values)[1:]).mean()
    assert codes[labels[0]] == np.float32(outlier)


@pytest.mark.parametrize("outlier", [1e10, 1e25])
def test_an_outlier_does_not_coarsen_a_palette(outlier: float) -> None:
    rows = np.random.default_rng(0).normal(size=(3000, 9)).astype(np.float32)
    wanted = palette(rows)
    rows[0] = outlier
    entries, labels = palette(rows)
    near = np.square((entries[labels] - rows)[1:]).mean()
    assert near < 1.2 * np.square((wanted.entries[wanted.labels] - rows)[1:]).mean()


def test_the_palette_represents_many_rows() -> None:
    rng = np.random.default_rng(0)
    centres = rng.normal(size=(16, 9))
    rows = centres[rng.integers(0, 16, 4000)] + 1e-3 * rng.normal(size=(4000, 9))
    entries, labels = palette(rows, 64)
    assert len(entries) <= 64
    assert np.abs(entries[labels] - rows).max() < 0.01
    few, same = palette(rows[:5], 64)
    assert np.array_equal(few[same], rows[:5])


@pytest.mark.parametrize(
    ("count", "size"),
    [(1, 1024), (1024, 1024), (2047, 1024), (15_000, 8192), (65_536, 65_536), (1 << 24, 65_536)],
)
def test_the_palette_size_follows_the_row_count(count: int, size: int) -> None:
    assert palette_size(count) == size


def test_palette_entries_are_spent_where_rows_differ_most() -> None:
    """All entries are used: nearly all for a wide cloud, hardly any for a tight one."""
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(3000, 9)).astype(np.float32)
    rows[:1500] *= 1e-3
    entries, labels = palette(rows)
    assert len(entries) == 2048
    assert len(np.unique(labels[:1500])) < 600
    wide = np.abs(entries[labels] - rows)[1500:]
    assert float(np.median(wide)) == 0.0


def test_the_codebook_of_a_small_scene_is_short() -> None:
    scene = replace(storable_scene(3000), comments=())
    file = io.BytesIO()
    write_sog(scene, file)
    with zipfile.ZipFile(file) as archive:
        sizes = {entry.filename: entry.file_size for entry in archive.infolist()}
        meta = json.loads(archive.read("meta.json"))
    assert meta["shN"]["count"] == 2048
    assert sizes["meta.json"] < 4 * 256 * 13
    assert all(float(str(np.float32(code))) == code for code in meta["shN"]["codebook"])


def test_equal_rows_have_one_palette_entry() -> None:
    assert len(palette(np.ones((100, 3)), 16).entries) == 1


def test_a_missing_first_code_is_extrapolated(tmp_path: Path) -> None:
    codes = [0.0, *range(1, 256)]
    found = load(changed(tmp_path, lambda m: m["scales"].update(codebook=[None, *codes[1:]])))
    whole = load(changed(tmp_path, lambda m: m["scales"].update(codebook=codes)))
    expected = torch.where(whole.log_scales == 0, 1 - 254 / 255, whole.log_scales)
    assert torch.equal(found.log_scales, expected)
    assert not torch.equal(found.log_scales, whole.log_scales)


DAMAGED: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "version": (lambda m: m.update(version=3), "'version' must be 1 or 2, found 3."),
    "count": (lambda m: m.update(count=0), "must state 1 to 268,402,689 Gaussians, found 0."),
    "lying count": (
        lambda m: m.update(count=200_000),
        "must have 200,000 pixels, found",
    ),
    "shape": (
        lambda m: (m.update(version=1), m["means"].update(shape=["many", 3])),
        "'shape' must be a list that starts with the number of Gaussians, found",
    ),
    "no means": (lambda m: m.pop("means"), "'means': must be a JSON object, found None."),
    "ranges": (lambda m: m["means"].update(mins=[0, 1]), "'mins' must be 3 finite numbers, found"),
    "codebook": (
        lambda m: m["scales"].update(codebook=[]),
        "'codebook' must be 1 to 256 finite numbers, found [].",
    ),
    "no code": (lambda m: m["sh0"].update(codebook=[1.0, None]), "'codebook' must be 1 to 256"),
    "short": (lambda m: m["sh0"].update(codebook=[None, 1.0]), "'codebook' must be 1 to 256"),
    "bands": (lambda m: m["shN"].update(bands=4), "'bands' must be 1, 2 or 3, found 4."),
    "other bands": (
        lambda m: m["shN"].update(bands=2),
        "shN_centroids.webp must be 512 pixels wide, found 192.",
    ),
    "files": (lambda m: m["sh0"].update(files=[]), "'files' must be 1 file name, found []."),
    "folder": (
        lambda m: m["sh0"].update(files=["../sh0.webp"]),
        "the files of a SOG must have names of at most 255 characters without folders, found "
        "'../sh0.webp'.",
    ),
    "no image": (
        lambda m: m["sh0"].update(files=["meta.json"]),
        "meta.json must be a WebP image, found something else.",
    ),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_each_damage_has_its_own_message(tmp_path: Path, name: str) -> None:
    change, text = DAMAGED[name]
    path = changed(tmp_path, change)
    with pytest.raises(FileFormatError) as caught:
        load(path)
    assert str(caught.value).startswith(str(tmp_path))
    assert text in str(caught.value)


def test_missing_images_are_refused(tmp_path: Path) -> None:
    path = unpacked(tmp_path)
    (tmp_path / "quats.webp").unlink()
    with pytest.raises(InputNotFoundError, match=r"quats\.webp: the file to read must exist"):
        load(path)
    with zipfile.ZipFile(tmp_path / "a.sog", "w") as archive:
        archive.write(path, "meta.json")
    with pytest.raises(FileFormatError) as caught:
        load(tmp_path / "a.sog")
    assert str(caught.value) == f"{tmp_path}/a.sog: must contain means_l.webp, found none."


def test_images_that_are_cut_short_are_refused(tmp_path: Path) -> None:
    path = unpacked(tmp_path)
    image = tmp_path / "quats.webp"
    image.write_bytes(image.read_bytes()[:-40])
    with pytest.raises(FileFormatError, match=r"quats\.webp must be an intact image, found: "):
        load(path)


def test_a_file_that_is_no_zip_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.sog"
    path.write_bytes(b"ply\n")
    with pytest.raises(FileFormatError) as caught:
        load(path)
    assert str(caught.value) == (
        f"{path}: a .sog must be a zip of meta.json and images, found no zip: file is not a "
        f"zip file."
    )


def test_oversized_files_and_images_are_not_unpacked(tmp_path: Path) -> None:
    """A meta.json of 32 MiB, an image file of 1 TiB, and 16 million pixels for 40 Gaussians."""
    path = tmp_path / "a.sog"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("meta.json", bytes(1 << 25))
    with pytest.raises(FileFormatError, match=r"meta\.json must have at most 1,048,576 bytes"):
        load(path)
    folder = tmp_path / "sog"
    meta = unpacked(folder)
    image = (folder / "scales.webp").read_bytes()
    with (folder / "scales.webp").open("wb") as file:
        file.truncate(1 << 40)  # sparse: uses no disk space
    with pytest.raises(FileFormatError, match=r"scales\.webp must have at most 394,016 bytes"):
        load(meta)
    (folder / "scales.webp").write_bytes(image)
    (folder / "quats.webp").write_bytes(encode_webp(np.zeros((4096, 4096, 4), np.uint8)))
    with pytest.raises(FileFormatError, match="must have at most 65,696 pixels, found 4096 x 4096"):
        load(meta)


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_random_damage_is_a_scene_or_a_cvtgs_error(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    content = bytearray(THEIRS.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.mktemp("sog") / "a.sog"
    path.write_bytes(bytes(content[: data.draw(st.integers(0, len(content)))]))
    text = refusal(path)
    assert text is None or text.startswith(str(path))


@pytest.mark.parametrize(
    "name", ["", "..", "a\x00b", "\ud800", "a\x1b[2J", "c:x", "a" * 5000 + "/b"]
)
def test_file_names_with_odd_characters_or_folders_are_refused(tmp_path: Path, name: str) -> None:
    path = changed(tmp_path, lambda meta: meta["quats"].update(files=[name]))
    text = refusal(path)
    assert (
        "the files of a SOG must have names of at most 255 characters without folders, found"
        in text
    )
    assert text.isprintable()
    assert len(text) < 200 + len(str(path))


def zip_version_99(data: bytearray) -> None:
    for start in (b"PK\x01\x02", b"PK\x03\x04"):
        at = data.index(start)
        data[at + 4 + 2 * (start[2] == 1)] = 99


def undecodable_name(data: bytearray) -> None:
    at = data.index(b"PK\x01\x02")
    data[at + 9] |= 8  # names are UTF-8
    data[at + 46] = 0xFF


def other_name_before_the_file(data: bytearray) -> None:
    data[30] = 0xFF
    data[7] |= 8


@pytest.mark.parametrize("damage", [zip_version_99, undecodable_name, other_name_before_the_file])
def test_damage_of_the_zip_is_refused(tmp_path: Path, damage: Callable[[bytearray], None]) -> None:
    data, path = bytearray(THEIRS.read_bytes()), tmp_path / "a.sog"
    damage(data)
    path.write_bytes(data)
    assert "found" in refusal(path)


def test_ranges_beyond_float32_give_no_warning(tmp_path: Path) -> None:
    path = changed(tmp_path, lambda meta: meta["means"].update(maxs=[1e308, 1e308, 1e308]))
    assert not load(path).means.isfinite().all()
