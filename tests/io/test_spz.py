"""Valid ``.spz`` files."""

import gzip
import math
import struct
from contextlib import nullcontext
from pathlib import Path

import pytest
import torch
from hypothesis import example, given, settings, strategies as st

from cvtgs import GaussianScene, load, save
from cvtgs.errors import DroppedDataWarning, InvalidArgumentError
from cvtgs.io import change_axes, losses
from cvtgs.io.atomic import atomic_output
from cvtgs.io.spz import Version, write_spz
from format_cases import (
    DATA,
    assert_as_oracle,
    assert_within,
    half_turn,
    storable_scene,
    with_extension,
)
from format_oracles import read_spz, unpacked_spz
from scenes import same_bits

BOUNDS = {
    "means": 0.5 / 4096,
    "log_scales": 0.5 / 16 + 1e-6,
    "opacities": 0.5 / 255 + 1e-6,
    "sh0": 0.5 / 255 / 0.15 + 1e-6,
    "first_band": 4.5 / 128,
    "higher_bands": 8.5 / 128,
    "angle": 0.006,
}
HEADER = struct.Struct("<4sIIBBBB")


def one_gaussian(version: int, quat: bytes, *, bits: int = 12, flags: int = 0) -> bytes:
    """Return a file of a Gaussian of SH degree 1 at (1, 2, -3), by hand."""
    mean = b"".join(int(x * 2**bits).to_bytes(3, "little", signed=True) for x in (1, 2, -3))
    rest = bytes([136, 128, 128, 120, 128, 128, 128, 144, 128])
    body = mean + bytes([51]) + bytes([255, 0, 0]) + bytes([160, 176, 192]) + quat + rest
    return gzip.compress(HEADER.pack(b"NGSP", version, 1, 1, bits, flags, 0) + body)


@pytest.mark.parametrize(
    ("version", "quat"),
    [
        (2, bytes([255, 128, 128])),
        (3, struct.pack("<I", 0)),  # the largest is x, the others are 0
    ],
)
def test_a_file_made_by_hand_is_read(tmp_path: Path, version: int, quat: bytes) -> None:
    """Files are in the axes of PLY files, as most tools write them, unless axes are given."""
    path = tmp_path / "a.spz"
    path.write_bytes(one_gaussian(version, quat, flags=1))
    scene = load(path)
    assert scene.means.tolist() == [[1, 2, -3]]
    assert scene.log_scales.tolist() == [[0, 1, 2]]
    torch.testing.assert_close(scene.opacities, torch.tensor([0.2]))
    torch.testing.assert_close(scene.sh0, torch.tensor([[[0.5, -0.5, -0.5]]]) / 0.15)
    assert scene.shN.tolist() == [[[8 / 128, 0, 0], [-8 / 128, 0, 0], [0, 16 / 128, 0]]]
    torch.testing.assert_close(
        scene.quats.abs(), torch.tensor([[0.0, 1.0, 0.0, 0.0]]), rtol=0, atol=0.01
    )
    assert scene.antialiased
    assert_as_oracle(scene, read_spz(path.read_bytes()))
    turned = load(path, axes="rub")  # y and z change signs, and bands odd in y or z
    assert turned.means.tolist() == [[1, -2, 3]]
    assert turned.shN.tolist() == [[[-8 / 128, 0, 0], [8 / 128, 0, 0], [0, 16 / 128, 0]]]


def test_half_precision_positions_of_version_1_are_read(tmp_path: Path) -> None:
    body = struct.pack("<3e", 1, 2, -3) + bytes([51, 255, 0, 0, 160, 176, 192, 128, 128, 128])
    path = tmp_path / "a.spz"
    path.write_bytes(gzip.compress(HEADER.pack(b"NGSP", 1, 1, 0, 12, 0, 0) + body))
    assert load(path).means.tolist() == [[1, 2, -3]]
    assert_as_oracle(load(path), read_spz(path.read_bytes()))


def test_the_fractional_bits_of_the_header_are_used(tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    for bits in (0, 7, 20):
        path.write_bytes(one_gaussian(3, bytes(4), bits=bits))
        assert load(path).means.tolist() == [[1, 2, -3]]


@pytest.mark.parametrize("version", [2, 3, 4])
def test_files_of_the_niantic_library_are_read(version: int) -> None:
    """They were written as by the apps of Niantic, with the axes of the PLY stated."""
    path, source = DATA / f"niantic-v{version}.spz", load(DATA / "source.ply")
    scene = load(path, axes="rub")
    bounds = BOUNDS | ({"angle": 0.2} if version == 2 else {})  # w is derived, badly if small
    assert_within(source, scene, bounds)
    assert_within(half_turn(source), load(path), bounds)
    assert scene.comments == ("SplatRenderMode: mip",)


@pytest.mark.parametrize("version", [2, 3, 4])
def test_written_files_match_those_of_the_niantic_library(tmp_path: Path, version: Version) -> None:
    """Decompressed bytes are equal, except one that may be rounded differently (a tie)."""
    path = tmp_path / "a.spz"
    source = change_axes(load(DATA / "source.ply"), "rdf", "rub")
    with atomic_output(path) as file:
        write_spz(source, file, version=version, axes="rub")
    ours, theirs = (
        unpacked_spz(one.read_bytes()) for one in (path, DATA / f"niantic-v{version}.spz")
    )
    assert len(ours) == len(theirs)
    stated = 2 if version == 4 else 0  # the flag for extensions
    assert ours[:16] == theirs[:14] + bytes([theirs[14] | stated]) + theirs[15:16]
    assert sum(a != b for a, b in zip(ours[16:], theirs[16:], strict=True)) <= 1
    splats = read_spz((DATA / f"niantic-v{version}.spz").read_bytes())
    assert_as_oracle(load(DATA / f"niantic-v{version}.spz"), splats)


@pytest.mark.parametrize("version", [3, 4])
def test_files_of_splat_transform_have_the_axes_of_the_ply(version: int) -> None:
    source = load(DATA / "source.ply")
    assert_within(source, load(DATA / f"splat-transform-v{version}.spz"), BOUNDS)


def test_files_are_in_the_axes_of_a_ply_unless_axes_are_given(tmp_path: Path) -> None:
    """Compared with spherical harmonics that an oracle rotates."""
    path, scene = tmp_path / "a.spz", storable_scene(30)
    save(scene, path)
    assert_within(scene, load(path), BOUNDS)
    save(scene, path, axes="rub", overwrite=True, spz_version=4)
    assert_within(scene, load(path), BOUNDS)  # the file states its axes
    assert_within(half_turn(scene), load(path, axes="rdf"), BOUNDS)
    save(scene, path, axes="rub", overwrite=True)
    assert_within(half_turn(scene), load(path), BOUNDS)
    assert_within(scene, load(path, axes="RUB"), BOUNDS)


def test_version_3_is_written_unless_another_is_given(tmp_path: Path) -> None:
    """Many viewers cannot read version 4 yet, and the first ones only version 2."""
    scene = storable_scene(3)
    save(scene, tmp_path / "a.spz")
    content = unpacked_spz((tmp_path / "a.spz").read_bytes())
    assert struct.unpack_from("<4sI", content) == (b"NGSP", 3)


def test_the_bytes_of_version_4_are_as_expected(tmp_path: Path) -> None:
    """The bytes of version 3 in six blocks behind a header that states the axes."""
    scene = storable_scene(3, degree=1)
    for version in (3, 4):
        save(scene, tmp_path / f"{version}.spz", axes="luf", spz_version=version)
    content = (tmp_path / "4.spz").read_bytes()
    third = unpacked_spz((tmp_path / "3.spz").read_bytes())
    assert content[:16] == HEADER.pack(b"NGSP", 4, 3, 1, third[13], 3, 6)
    assert struct.unpack_from("<7I", content, 16) == (44, 0, 0, 0, 0xADBE0003, 4, 7)
    sizes = [struct.unpack_from("<QQ", content, 44 + 16 * block)[1] for block in range(6)]
    assert sizes == [27, 3, 9, 9, 12, 27]
    assert unpacked_spz(content)[16:] == third[16:]
    save(scene.with_sh_degree(0), tmp_path / "0.spz", spz_version=4)
    assert (tmp_path / "0.spz").read_bytes()[15] == 5


def test_axes_have_the_numbers_of_the_niantic_library(tmp_path: Path) -> None:
    """The order of its enumeration CoordinateSystem, in splat-types.h."""
    names = [
        "ldb",
        "rdb",
        "lub",
        "rub",
        "ldf",
        "rdf",
        "luf",
        "ruf",
        "lfd",
        "rfd",
        "lfu",
        "rfu",
        "lbd",
        "rbd",
        "lbu",
        "rbu",
    ]
    for number, axes in enumerate(names, start=1):
        path = tmp_path / f"{axes}.spz"
        save(storable_scene(1, degree=0), path, axes=axes, spz_version=4)
        assert struct.unpack_from("<3I", path.read_bytes(), 32) == (0xADBE0003, 4, number)


@pytest.mark.parametrize("version", [1, 5, "4", 3.0])
def test_unknown_versions_are_not_written(tmp_path: Path, version: Version) -> None:
    with pytest.raises(InvalidArgumentError, match="must be 2, 3 or 4, found"):
        save(storable_scene(3), tmp_path / "a.spz", spz_version=version)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("number", "axes"),
    [(0, "rub"), (1, "ldb"), (4, "rub"), (6, "rdf"), (9, "lfd"), (12, "rfu"), (16, "rbu")],
)
def test_the_axes_that_a_file_states_are_used(tmp_path: Path, number: int, axes: str) -> None:
    """The extension of Adobe follows an unknown one; the argument takes precedence."""
    path, fourth = tmp_path / "a.spz", (DATA / "splat-transform-v4.spz").read_bytes()
    other = with_extension(fourth, 0x12340001, b"unknown")
    path.write_bytes(with_extension(other, 0xADBE0003, number.to_bytes(4, "little")))
    plain = load(DATA / "splat-transform-v4.spz")
    assert same_bits(load(path), change_axes(plain, axes, "rdf"))
    assert same_bits(load(path, axes="rdf"), plain)


@pytest.mark.parametrize("version", [2, 3])
def test_extensions_of_older_versions_follow_the_gaussians(tmp_path: Path, version: int) -> None:
    """As Niantic's library wrote them: records of type, length and content."""
    path = tmp_path / "a.spz"
    plain = load(DATA / f"niantic-v{version}.spz")
    content = gzip.decompress((DATA / f"niantic-v{version}.spz").read_bytes())
    content = content[:14] + bytes([content[14] | 2]) + content[15:]
    path.write_bytes(gzip.compress(content))  # the flag alone
    assert same_bits(load(path), plain)
    orbit = struct.pack("<II3f", 0xADBE0002, 12, -0.5, 0.5, 1.0)
    path.write_bytes(gzip.compress(content + orbit))
    assert same_bits(load(path), plain)
    path.write_bytes(gzip.compress(content + orbit + struct.pack("<III", 0xADBE0003, 4, 4)))
    assert same_bits(load(path), change_axes(plain, "rub", "rdf"))
    assert same_bits(load(path, axes="rdf"), plain)


@settings(max_examples=20, deadline=None)
@given(count=st.integers(1, 40), seed=st.integers(0, 1000), degree=st.integers(0, 3))
@example(count=14, seed=347, degree=0)  # its two largest components are equal
def test_round_trip(
    tmp_path_factory: pytest.TempPathFactory, count: int, seed: int, degree: int
) -> None:
    path = tmp_path_factory.mktemp("spz") / "a.spz"
    scene = storable_scene(count, seed=seed, degree=degree)
    save(scene, path)
    again = load(path)
    assert_within(scene, again, BOUNDS)
    assert again.sh_degree == degree
    assert again.antialiased
    assert_as_oracle(load(path), read_spz(path.read_bytes()))
    save(again, path, overwrite=True)
    for name, tensor in load(path).tensors().items():
        wanted, bound = again.tensors()[name], 1e-5
        if name == "quats":  # q and -q are the same rotation
            wanted = wanted * (tensor * wanted).sum(dim=1, keepdim=True).sign()
            bound = 2e-3
        torch.testing.assert_close(tensor, wanted, rtol=0, atol=bound)


@pytest.mark.parametrize(
    ("spread", "bits"), [(1e-3, 22), (0.05, 17), (1.0, 13), (100.0, 12), (1500.0, 10), (1e6, 1)]
)
def test_fractional_bits_depend_on_the_scene_size(tmp_path: Path, spread: float, bits: int) -> None:
    scene = storable_scene(2000, degree=0)
    path = tmp_path / "a.spz"
    unit = scene.means / scene.means.abs().max() * 3.9 * spread
    coarse = pytest.warns(DroppedDataWarning, match=r"digits of positions \(steps of 0\.5")
    with coarse if bits < 10 else nullcontext():
        save(scene.with_tensors({"means": unit}, {}), path)
    assert unpacked_spz(path.read_bytes())[13] == bits
    assert float((load(path).means - unit).abs().max()) <= 0.5 / 2**bits * 1.01


def test_usual_steps_are_no_loss_of_digits() -> None:
    """Even if Gaussians are smaller: 1/4096 is what every file of the format has."""
    scene = storable_scene(200, degree=0)
    thin = scene.with_tensors(log_scales=scene.log_scales * 0 - 9.9)
    assert not [phrase for phrase in losses(thin, ".spz").dropped if "digits" in phrase]


def test_flyaways_do_not_reduce_the_precision_of_others(tmp_path: Path) -> None:
    scene, path = storable_scene(2000, degree=0), tmp_path / "a.spz"
    means = scene.means.clone()
    means[7] = torch.tensor([1e7, 0.0, -1e7])
    with pytest.warns(
        DroppedDataWarning, match=r"coordinates outside \[-1024, 1024\], which are clamped \(1 Gau"
    ):
        save(scene.with_tensors({"means": means}, {}), path)
    again = load(path).means
    torch.testing.assert_close(again[7], torch.tensor([1024.0, 0.0, -1024.0]), rtol=1e-5, atol=0)
    others = torch.arange(2000) != 7
    assert float((again - means)[others].abs().max()) <= 0.5 / 4096


def test_clamped_values_are_warned_about(tmp_path: Path) -> None:
    scene = GaussianScene(
        means=torch.zeros(3, 3),
        quats=torch.tensor([[1.0, 1, 1, 1], [-1, 0, 0, 0], [0, 0, 1e-20, 0]]),
        log_scales=torch.tensor([[-20.0, 0, 0], [0, 0, 0], [9, 0, 0]]),
        logit_opacities=torch.tensor([-math.inf, 0.0, math.inf]),
        sh0=torch.full((3, 1, 3), 9.0),
        shN=torch.full((3, 3, 3), -2.0),
    )
    with pytest.warns(DroppedDataWarning) as caught:
        save(scene, tmp_path / "a.spz")
    text = str(caught[0].message)
    for part in ("log-scales outside", "clamped (2 Gaussians)", "colours (SH band 0) outside"):
        assert part in text
    again = load(tmp_path / "a.spz")
    assert again.log_scales[:, 0].tolist() == [-10, 0, 5.9375]
    torch.testing.assert_close(again.opacities, torch.tensor([1e-6, 128 / 255, 1 - 1e-6]))
    assert_within(scene, again, {"angle": 0.006})


def test_the_same_scene_gives_the_same_bytes(tmp_path: Path) -> None:
    scene = storable_scene(50)
    for name in ("a.spz", "b.spz"):
        save(scene, tmp_path / name)
    assert (tmp_path / "a.spz").read_bytes() == (tmp_path / "b.spz").read_bytes()
