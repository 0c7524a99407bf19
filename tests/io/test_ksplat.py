"""``.ksplat`` files of all compressions, with several sections, and with damage."""

import struct
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import cvtgs
from cvtgs.errors import FileFormatError
from cvtgs.math.parameters import quats_to_matrices

COMPONENTS = (0, 9, 24)
BLOCK, SIZE = 20.0, 256


def section(level: int, degree: int, count: int, seed: int) -> tuple[bytes, bytes, dict[str, Any]]:
    """Return a header, its data and the values in it: full buckets, and two partial ones.

    splat-transform 3.7.0 reads files like these as cvtgs does.
    """
    rng = np.random.default_rng(seed)
    values = {
        "means": rng.normal(size=(count, 3)).astype("f4"),
        "scales": np.exp(rng.normal(size=(count, 3)) - 3).astype("f4"),
        "quats": rng.normal(size=(count, 4)).astype("f4"),
        "rgba": rng.integers(1, 255, (count, 4)).astype("u1"),
        "sh": rng.uniform(-1, 1, (count, COMPONENTS[degree])).astype("f4"),
    }
    full = count // SIZE
    partial = [30, count % SIZE - 30]
    centers = rng.normal(size=(full + 2, 3)).astype("<f4")
    buckets = np.repeat(np.arange(full + 2), [*[SIZE] * full, *partial])
    steps = np.round((values["means"] - centers[buckets]) / (BLOCK / 2 / 32767)) + 32767
    means = values["means"].astype("<f4") if level == 0 else steps.astype("<u2")
    half = "<f4" if level == 0 else "<f2"
    levels = np.round((values["sh"] + 1.5) / 3 * 255).astype("u1")
    sh = levels if level == 2 else values["sh"].astype(half)
    columns = [means, values["scales"].astype(half), values["quats"].astype(half)]
    columns += [values["rgba"], sh]
    rows = [np.ascontiguousarray(column).view("u1").reshape(count, -1) for column in columns]
    joined = np.concatenate(rows, axis=1)
    numbers = (count, count + 3, SIZE, full + 2, BLOCK, 12, 32767, 0, full, 2, degree)
    head = struct.pack("<IIIIfHxxIIIIH", *numbers)
    spare = bytes(3 * joined.shape[1])  # room for three more
    data = np.array(partial, "<u4").tobytes() + centers.tobytes() + joined.tobytes() + spare
    return head.ljust(1024, b"\0"), data, values


def write(path: Path, level: int, *sections: tuple[bytes, bytes, dict[str, Any]]) -> Path:
    count = sum(len(values["means"]) for _, _, values in sections)
    head = struct.pack("<BBxxIIIIHxx3fff", 0, 1, 4, 4, count, count, level, 0, 0, 0, -1.5, 1.5)
    heads = b"".join(head for head, _, _ in sections).ljust(4 * 1024, b"\0")
    data = b"".join(data for _, data, _ in sections)
    path.write_bytes(head.ljust(4096, b"\0") + heads + data)
    return path


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_every_compression_is_read(tmp_path: Path, level: int, degree: int) -> None:
    first, second = section(level, degree, 700, 0), section(level, 0, 300, 1)
    scene = cvtgs.load(write(tmp_path / "a.ksplat", level, first, second))
    assert (len(scene), scene.sh_degree) == (1000, degree)
    near = 1e-5 if level == 0 else 2e-3
    for part, (_, _, values) in ((scene[:700], first), (scene[700:], second)):
        for found, name in ((part.means, "means"), (part.scales, "scales")):
            wanted = torch.from_numpy(values[name])
            torch.testing.assert_close(found, wanted, rtol=near, atol=near)
        quats = torch.from_numpy(values["quats"])
        matrices = quats_to_matrices(quats / quats.norm(dim=1, keepdim=True))
        torch.testing.assert_close(quats_to_matrices(part.quats), matrices, rtol=0, atol=4e-3)
        rgba = torch.from_numpy(values["rgba"].astype("f4")) / 255
        torch.testing.assert_close(part.opacities, rgba[:, 3], rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(part.sh0[:, 0] * 0.28209479 + 0.5, rgba[:, :3])
    stored, step = torch.from_numpy(first[2]["sh"]), 0.007 if level else 1e-6
    if degree:  # of band 1 those of red, then of green, then of blue
        torch.testing.assert_close(scene.shN[:700, :3, 1], stored[:, 3:6], rtol=0, atol=step)
    if degree == 2:
        torch.testing.assert_close(scene.shN[:700, 3:, 2], stored[:, 19:24], rtol=0, atol=step)
    assert not scene.shN[700:].any()


@pytest.mark.parametrize(
    ("stated", "bounds"),
    [((0, 0), (-1.5, 1.5)), ((0, 0.5), (-1.5, 0.5)), ((-2, 0), (-2, 1.5)), ((-1, 2), (-1, 2))],
)
def test_a_bound_of_0_stands_for_the_usual_one(
    tmp_path: Path, stated: tuple[float, float], bounds: tuple[float, float]
) -> None:
    """Each for itself, as in GaussianSplats3D and splat-transform."""
    path = write(tmp_path / "a.ksplat", 2, section(2, 1, 700, 0))
    content = path.read_bytes()
    path.write_bytes(content[:36] + struct.pack("<ff", *stated) + content[44:])
    levels = np.round((section(2, 1, 700, 0)[2]["sh"][:, :3] + 1.5) / 3 * 255) / 255
    wanted = torch.from_numpy(bounds[0] + levels * (bounds[1] - bounds[0])).float()
    torch.testing.assert_close(cvtgs.load(path).shN[:, :, 0], wanted)


@pytest.mark.parametrize(
    ("place", "number", "text"),
    [
        (1, struct.pack("<B", 2), "must be a .ksplat of version 0.1 with compression 0, 1 or 2"),
        (20, struct.pack("<H", 7), "must be a .ksplat of version 0.1 with compression 0, 1 or 2"),
        (
            4,
            struct.pack("<I", 1 << 30),
            "must hold the headers of 1,073,741,824 sections, found 37,774 bytes.",
        ),
        (
            16,
            struct.pack("<I", 701),
            "must hold the 701 Gaussians of the header",
        ),
        (4096, struct.pack("<I", 1 << 30), "found 29,582 bytes and room for 703."),
        (4096 + 4, struct.pack("<I", 699), "found 29,582 bytes and room for 699."),
        (4096 + 12, struct.pack("<I", 1 << 30), "a section of 700 Gaussians must take"),
        (4096 + 32, struct.pack("<I", 1), "buckets of a section must hold 700 Gaussians"),
        (4096 + 40, struct.pack("<H", 3), "must have an SH degree of at most 2, found 3"),
    ],
)
def test_damage_is_one_sentence(tmp_path: Path, place: int, number: bytes, text: str) -> None:
    path = write(tmp_path / "a.ksplat", 1, section(1, 1, 700, 0))
    content = path.read_bytes()
    path.write_bytes(content[:place] + number + content[place + len(number) :])
    with pytest.raises(FileFormatError) as caught:
        cvtgs.load(path)
    assert text in str(caught.value)


def test_a_file_without_gaussians_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="at least 1, found 0"):
        cvtgs.load(write(tmp_path / "a.ksplat", 1))


def test_a_gaussian_in_no_bucket_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "a.ksplat", 1, section(1, 0, 200, seed=1))
    content = path.read_bytes()
    path.write_bytes(content[:8192] + struct.pack("<I", 29) + content[8196:])
    with pytest.raises(FileFormatError, match="buckets of a section must hold 200 Gaussians"):
        cvtgs.load(path)


@pytest.mark.parametrize(("stated", "ratio"), [(0, 1.0), (16383, 32767 / 16383)])
def test_a_section_may_state_the_range_of_its_positions(
    tmp_path: Path, stated: int, ratio: float
) -> None:
    """It is half of the number of steps in a block; 0 stands for the usual one."""
    path = write(tmp_path / "a.ksplat", 1, section(1, 0, 300, seed=1))
    before, content = cvtgs.load(path).means, path.read_bytes()
    path.write_bytes(content[:4120] + struct.pack("<I", stated) + content[4124:])
    found = cvtgs.load(path).means
    torch.testing.assert_close(found[1] - found[0], ratio * (before[1] - before[0]))


def test_a_huge_bucket_size_takes_no_memory(tmp_path: Path) -> None:
    path = write(tmp_path / "a.ksplat", 1, section(1, 0, 300, seed=1))
    content = bytearray(path.read_bytes())
    content[4096 + 8 : 4096 + 12] = b"\0\0\0\x08"
    path.write_bytes(content)
    tracemalloc.start()
    try:
        assert len(cvtgs.load(path)) == 300
        assert tracemalloc.get_traced_memory()[1] < 10_000_000
    finally:
        tracemalloc.stop()


def test_cut_or_damaged_files_give_a_scene_or_a_format_error(tmp_path: Path) -> None:
    content = write(tmp_path / "a.ksplat", 1, section(1, 1, 700, 0)).read_bytes()
    rng, read = np.random.default_rng(0), 0
    for case in range(200):
        damaged = bytearray(content if case % 4 else content[: rng.integers(1, len(content))])
        heads = [*range(24), *range(4096, 4140), *range(8192, 8400)]
        for place in rng.choice(heads, 1 + case % 3):
            if place < len(damaged):
                damaged[place] = rng.integers(256)
        (tmp_path / "b.ksplat").write_bytes(damaged)
        try:
            cvtgs.load(tmp_path / "b.ksplat")
            read += 1
        except FileFormatError:
            pass
    assert 0 < read < 200
