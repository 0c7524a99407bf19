"""Damaged ``.spz`` files: one sentence each, and little memory."""

import gzip
import struct
import tracemalloc
import zlib
from pathlib import Path

import pytest
import zstandard
from hypothesis import given, settings, strategies as st

from cvtgs import load
from cvtgs.errors import DroppedDataWarning, FileFormatError
from format_cases import DATA, refusal, with_extension
from format_oracles import read_spz
from scenes import same_bits

GOOD = gzip.decompress((DATA / "niantic-v3.spz").read_bytes())
FOURTH = (DATA / "niantic-v4.spz").read_bytes()


def header(*, magic=b"NGSP", version=3, count=40, degree=3, bits=12, flags=0, last=0) -> bytes:
    return struct.pack("<4sIIBBBB", magic, version, count, degree, bits, flags, last)


STARTED = (
    "an .spz file must start with a header of 16 bytes that begin with b'NGSP', in gzip or not"
)
WANTED = "must hold 2,600 bytes for the 40 Gaussians of SH degree 3 that the header promises"

DAMAGED = {
    "empty": (b"", f"{STARTED}, found 0 that begin with b''."),
    "other": (
        b"ply\n",
        f"{STARTED}, found 4 that begin with b'ply\\n'.",
    ),
    "short": (
        gzip.compress(GOOD[:10]),
        f"{STARTED}, found 10 that begin with b'NGSP'.",
    ),
    "magic": (
        gzip.compress(header(magic=b"NOPE") + GOOD[16:]),
        f"{STARTED}, found 16 that begin with b'NOPE'.",
    ),
    "version": (
        gzip.compress(header(version=7) + GOOD[16:]),
        "the version must be 1 to 3, or 4 without gzip, found 7.",
    ),
    "zipped version 4": (
        gzip.compress(header(version=4) + GOOD[16:]),
        "the version must be 1 to 3, or 4 without gzip, found 4.",
    ),
    "none": (
        gzip.compress(header(count=0)),
        "must hold at least one Gaussian of SH degree 0 to 4 with at most 24 "
        "fractional bits, found 0 of degree 3 with 12.",
    ),
    "degree": (
        gzip.compress(header(degree=5) + GOOD[16:]),
        "must hold at least one Gaussian of SH degree 0 to 4 with at most 24 "
        "fractional bits, found 40 of degree 5 with 12.",
    ),
    "bits": (
        gzip.compress(header(bits=25) + GOOD[16:]),
        "must hold at least one Gaussian of SH degree 0 to 4 with at most 24 "
        "fractional bits, found 40 of degree 3 with 25.",
    ),
    "one byte less": (gzip.compress(GOOD[:-1]), f"{WANTED}, found 2,599."),
    "too many": (
        gzip.compress(header(count=41) + GOOD[16:]),
        "must hold 2,665 bytes for the 41 Gaussians of SH degree 3 that the header promises, "
        "found 2,600.",
    ),
    "cut off": (gzip.compress(GOOD)[:-30], f"{WANTED}, found "),
    "without checksum": (
        gzip.compress(GOOD)[:-4],
        "must be intact gzip data, found it cut short.",
    ),
    "wrong checksum": (
        gzip.compress(GOOD)[:-8] + bytes(8),
        "must be intact gzip data, found damage: Error -3 while decompressing data: incorrect data "
        "check.",
    ),
    "not gzip": (b"\x1f\x8b" + bytes(50), "must be intact gzip data, found damage: Error -3 while"),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_each_damage_has_its_own_message(tmp_path: Path, name: str) -> None:
    content, text = DAMAGED[name]
    path = tmp_path / "a.spz"
    path.write_bytes(content)
    with pytest.raises(FileFormatError) as caught:
        load(path)
    assert str(caught.value).startswith(f"{path}: {text}")


def test_the_undamaged_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    path.write_bytes(gzip.compress(GOOD))
    assert len(load(path)) == len(read_spz(path.read_bytes())) == 40


@pytest.mark.parametrize("ends", [[5, 16], [16, 100, 2616], [100, 100, 101], [2616]])
@pytest.mark.parametrize("padding", [b"", bytes(600)])
def test_gzip_files_of_several_members_are_read(
    tmp_path: Path, ends: list[int], padding: bytes
) -> None:
    path, whole = tmp_path / "a.spz", tmp_path / "whole.spz"
    whole.write_bytes(gzip.compress(GOOD))
    pieces = [GOOD[low:high] for low, high in zip([0, *ends], [*ends, None], strict=True)]
    path.write_bytes(b"".join(map(gzip.compress, pieces)) + padding)
    assert same_bits(load(path), load(whole))


@pytest.mark.parametrize(
    ("second", "text"),
    [
        (gzip.compress(GOOD[50:])[:-4], "must be intact gzip data, found it cut short."),
        (gzip.compress(GOOD[50:])[:-8] + bytes(8), "must be intact gzip data, found damage: "),
        (bytes(600) + gzip.compress(GOOD[50:]), f"{WANTED}, found 34."),
    ],
)
def test_damage_of_a_further_member_is_noticed(tmp_path: Path, second: bytes, text: str) -> None:
    path = tmp_path / "a.spz"
    path.write_bytes(gzip.compress(GOOD[:50]) + second)
    with pytest.raises(FileFormatError, match=text):
        load(path)


@pytest.mark.parametrize("count", [2**20, 2**32 - 1])
def test_a_false_count_takes_no_memory(tmp_path: Path, count: int) -> None:
    path = tmp_path / "a.spz"
    path.write_bytes(gzip.compress(header(count=count) + GOOD[16:]))
    tracemalloc.start()
    for trust_sizes, text in ((False, f"found {count:,} Gaussians"), (True, "promises, found")):
        with pytest.raises(FileFormatError, match=text):
            load(path, trust_sizes=trust_sizes)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 4 << 20


@pytest.mark.slow
@pytest.mark.parametrize("members", [1, 2])
def test_surplus_data_is_not_unpacked(tmp_path: Path, members: int) -> None:
    """The file holds 256 MiB of zeros after 40 Gaussians."""
    squeeze = zlib.compressobj(9, wbits=31)
    content = squeeze.compress(GOOD)
    if members > 1:
        content += squeeze.flush()
        squeeze = zlib.compressobj(9, wbits=31)
    content += b"".join(squeeze.compress(bytes(1 << 24)) for _ in range(16)) + squeeze.flush()
    path = tmp_path / "a.spz"
    path.write_bytes(content)
    tracemalloc.start()
    with pytest.warns(DroppedDataWarning) as caught:
        assert len(load(path)) == 40
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 8 << 20
    assert str(caught[0].message) == (
        f"{path}: left out the bytes after the 40 Gaussians of the header."
    )
    assert caught[0].filename == __file__


@pytest.mark.parametrize(
    "body",
    [
        pytest.param(struct.pack("<Iff", 0xADBE0002, -0.5, 0.5) + GOOD[16:], id="before"),
        pytest.param(GOOD[16:] + struct.pack("<II", 0xADBE0002, 12) + bytes(8), id="cut record"),
        pytest.param(GOOD[16:] + bytes(3), id="no record"),
        pytest.param(GOOD[16:] + bytes((1 << 20) + 8), id="too much"),
    ],
)
def test_extensions_of_version_3_that_are_no_records_are_refused(
    tmp_path: Path, body: bytes
) -> None:
    """A draft of the format had them before the Gaussians."""
    path = tmp_path / "a.spz"
    path.write_bytes(gzip.compress(header(flags=2) + body))
    assert refusal(path) == (
        f"{path}: the extensions after the Gaussians must be whole records of at most 1,048,576 "
        f"bytes together, found others; write it as version 4."
    )


def test_bands_above_the_third_are_left_out(tmp_path: Path) -> None:
    rest = bytes(range(72))
    path = tmp_path / "a.spz"
    path.write_bytes(gzip.compress(header(count=1, degree=4) + bytes(20) + rest))
    with pytest.warns(DroppedDataWarning) as caught:
        scene = load(path)
    assert str(caught[0].message) == (
        f"{path}: left out the SH bands above degree 3 (the file has degree 4)."
    )
    assert caught[0].filename == __file__
    assert scene.sh_degree == 3


FOURTH_DAMAGED = {
    "header": (
        FOURTH[:12],
        f"{STARTED}, found 12",
    ),
    "version": (
        FOURTH[:4] + b"\x05" + FOURTH[5:],
        "the version must be 1 to 3, or 4 without gzip, found 5.",
    ),
    "table": (
        FOURTH[:16] + b"\xff\xff\xff\x7f" + FOURTH[20:],
        f"must hold 6 blocks, found a table of 6 at byte 2,147,483,647 of {len(FOURTH):,}.",
    ),
    "blocks": (
        FOURTH[:15] + b"\x03" + FOURTH[16:],
        f"must hold 6 blocks, found a table of 3 at byte 32 of {len(FOURTH):,}.",
    ),
    "count": (
        FOURTH[:8] + b"\x29\x00\x00\x00" + FOURTH[12:],
        "block 'means' must have 369 bytes for 41 Gaussians, found 360 in",
    ),
    "cut short": (FOURTH[:-1], "block 'sh' must have 1,800 bytes for 40 Gaussians, found 1,800 in"),
    "axes": (
        with_extension(FOURTH, 0xADBE0003, struct.pack("<I", 17)),
        "the extension for the axes must hold a 4-byte number from 0 to 16, found 17 in 4",
    ),
    "size of axes": (
        with_extension(FOURTH, 0xADBE0003, b"\x04"),
        "the extension for the axes must hold a 4-byte number from 0 to 16, found 4 in 1",
    ),
    "no zstd": (
        FOURTH[:128] + bytes(len(FOURTH) - 128),
        "block 'means' must be intact zstd data, found",
    ),
}


@pytest.mark.parametrize("name", FOURTH_DAMAGED)
def test_each_damage_of_version_4_has_its_own_message(tmp_path: Path, name: str) -> None:
    content, text = FOURTH_DAMAGED[name]
    path = tmp_path / "a.spz"
    path.write_bytes(content)
    with pytest.raises(FileFormatError) as caught:
        load(path)
    assert str(caught.value).startswith(f"{path}: {text}")


@pytest.mark.parametrize(("size", "found"), [(359, "359"), (400, "more"), (1 << 28, "more")])
def test_blocks_of_a_wrong_size_are_refused(tmp_path: Path, size: int, found: str) -> None:
    block = zstandard.ZstdCompressor().compress(bytes(size))
    table = struct.pack("<QQ", len(block), 360)
    path = tmp_path / "a.spz"
    path.write_bytes(FOURTH[:32] + table + FOURTH[48:128] + block + bytes(len(FOURTH)))
    tracemalloc.start()
    with pytest.raises(FileFormatError) as caught:
        load(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert str(caught.value) == f"{path}: block 'means' must have 360 bytes, found {found}."
    assert peak < 4 << 20


@settings(max_examples=60, deadline=None)
@given(data=st.data(), which=st.sampled_from(["niantic-v2.spz", "niantic-v4.spz"]))
@pytest.mark.filterwarnings("ignore::cvtgs.errors.DroppedDataWarning")
def test_random_damage_is_a_scene_or_a_cvtgs_error(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject, which: str
) -> None:
    content = bytearray((DATA / which).read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.mktemp("spz") / "a.spz"
    path.write_bytes(bytes(content[: data.draw(st.integers(0, len(content)))]))
    text = refusal(path)
    assert text is None or text.startswith(str(path))
