"""Slow readers of compact formats, one Gaussian at a time, without code of cvtgs.

Each returns a list of Gaussians in the order and the axes of the file.
"""

import gzip
import io
import json
import math
import re
import struct
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import zstandard
from PIL import Image

C0 = 0.28209479177387814


@dataclass
class Splat:
    mean: list[float]
    quat: list[float]
    log_scale: list[float]
    opacity: float
    sh0: list[float]
    rest: list[list[float]] = field(default_factory=list)


def unit(quat):
    length = math.sqrt(sum(part * part for part in quat))
    return [part / length for part in quat]


def with_largest(largest, three):
    """Insert the missing component of a unit quaternion."""
    missing = math.sqrt(max(0.0, 1 - sum(part * part for part in three)))
    return [*three[:largest], missing, *three[largest:]]


def read_splat(content: bytes) -> list[Splat]:
    found = []
    for start in range(0, len(content), 32):
        x, y, z, a, b, c, *rest = struct.unpack_from("<6f8B", content, start)
        red, green, blue, opacity, *quat = rest
        found.append(
            Splat(
                mean=[x, y, z],
                quat=unit([(part - 128) / 128 for part in quat]),
                log_scale=[math.log(scale) for scale in (a, b, c)],
                opacity=opacity / 255,
                sh0=[(part / 255 - 0.5) / C0 for part in (red, green, blue)],
            )
        )
    return found


def unpacked_spz(content: bytes) -> bytes:
    """Return the header and blocks of any version, in the layout before version 4."""
    if content[:2] == b"\x1f\x8b":
        return gzip.decompress(content)
    (streams,), (start,) = content[15:16], struct.unpack_from("<I", content, 16)
    at = start + 16 * streams
    blocks = []
    for number in range(streams):
        packed, size = struct.unpack_from("<QQ", content, start + 16 * number)
        blocks.append(zstandard.decompress(content[at : at + packed]))
        assert len(blocks[-1]) == size
        at += packed
    assert at == len(content)
    return content[:16] + b"".join(blocks)


def read_spz(content: bytes) -> list[Splat]:
    """Read any version, without a change of axes."""
    data = unpacked_spz(content)
    magic, version, count, degree, bits, _, _ = struct.unpack_from("<IIIBBBB", data)
    assert magic == int.from_bytes(b"NGSP", "little")
    k = {0: 0, 1: 3, 2: 8, 3: 15, 4: 24}[degree]
    position_size, quat_size = 6 if version == 1 else 9, 4 if version > 2 else 3
    at = 16
    starts = []
    for size in (position_size, 1, 3, 3, quat_size, 3 * k):
        starts.append(at)
        at += count * size
    assert at == len(data)
    means, opacities, colors, scales, quats, rest = starts
    found = []
    for i in range(count):
        if version == 1:
            mean = list(struct.unpack_from("<3e", data, means + 6 * i))
        else:
            parts = [data[means + 9 * i + 3 * axis :][:3] for axis in range(3)]
            mean = [int.from_bytes(part, "little", signed=True) / 2**bits for part in parts]
        stored = data[quats + quat_size * i :][:quat_size]
        values = [(byte - 128) / 128 for byte in data[rest + 3 * k * i :][: 3 * k]]
        found.append(
            Splat(
                mean=mean,
                quat=spz_quat_of_4(stored) if quat_size == 4 else spz_quat_of_3(stored),
                log_scale=[byte / 16 - 10 for byte in data[scales + 3 * i :][:3]],
                opacity=data[opacities + i] / 255,
                sh0=[(byte / 255 - 0.5) / 0.15 for byte in data[colors + 3 * i :][:3]],
                rest=[values[3 * j : 3 * j + 3] for j in range(k)],
            )
        )
    return found


def spz_quat_of_3(stored: bytes) -> list[float]:
    x, y, z = (byte / 127.5 - 1 for byte in stored)
    return [math.sqrt(max(0.0, 1 - x * x - y * y - z * z)), x, y, z]


def spz_quat_of_4(stored: bytes) -> list[float]:
    word = int.from_bytes(stored, "little")
    three = []
    for shift in (20, 10, 0):
        part = (word >> shift) & 1023
        size = (part & 511) / 511 * math.sqrt(0.5)
        three.append(-size if part & 512 else size)
    x, y, z, w = with_largest(word >> 30, three)
    return [w, x, y, z]


def read_compressed_ply(content: bytes) -> list[Splat]:
    header, data = content.split(b"end_header\n", 1)
    lines = header.decode().split("\n")
    counts = {line.split()[1]: int(line.split()[2]) for line in lines if line[:7] == "element"}
    rest_count = sum("f_rest" in line for line in lines)
    width = sum(line.startswith("property float") for line in lines)
    vertices = counts["chunk"] * width * 4
    harmonics = vertices + 16 * counts["vertex"]
    found = []
    for i in range(counts["vertex"]):
        ranges = list(struct.unpack_from(f"<{width}f", data, i // 256 * width * 4))
        ranges += [0.0, 0.0, 0.0, 1.0, 1.0, 1.0][width - 12 :] if width == 12 else []
        place, turn, scale, color = struct.unpack_from("<4I", data, vertices + 16 * i)
        shown = between([color >> 24, color >> 16 & 255, color >> 8 & 255], (255,) * 3, ranges[12:])
        three = [((turn >> shift & 1023) / 1023 - 0.5) * math.sqrt(2) for shift in (20, 10, 0)]
        stored = data[harmonics + rest_count * i :][:rest_count]
        k = rest_count // 3
        found.append(
            Splat(
                mean=between(fields(place), (2047, 1023, 2047), ranges[:6]),
                quat=with_largest(turn >> 30, three),
                log_scale=between(fields(scale), (2047, 1023, 2047), ranges[6:12]),
                opacity=(color & 255) / 255,
                sh0=[(part - 0.5) / C0 for part in shown],
                rest=[[rest_value(stored[c * k + j]) for c in range(3)] for j in range(k)],
            )
        )
    return found


def fields(word: int) -> list[int]:
    return [word >> 21, word >> 11 & 1023, word & 2047]


def between(numbers, most, ranges) -> list[float]:
    parts = zip(numbers, most, ranges[:3], ranges[3:], strict=True)
    return [low + (high - low) * number / top for number, top, low, high in parts]


def rest_value(byte: int) -> float:
    share = {0: 0.0, 255: 1.0}.get(byte, (byte + 0.5) / 256)
    return 8 * (share - 0.5)


def read_sog(path: Path) -> list[Splat]:
    """Read a bundled SOG of version 2."""
    archive = zipfile.ZipFile(path)
    meta = json.loads(archive.read("meta.json"))
    pixels = {}
    for name in archive.namelist():
        if name.endswith(".webp"):
            image = Image.open(io.BytesIO(archive.read(name))).convert("RGBA")
            pixels[name] = image
    found = []
    for i in range(meta["count"]):

        def at(name, i=i):
            return pixels[name].getpixel((i % pixels[name].width, i // pixels[name].width))

        low, high = at("means_l.webp"), at("means_u.webp")
        mean = []
        for axis in range(3):
            least, most = meta["means"]["mins"][axis], meta["means"]["maxs"][axis]
            value = least + (most - least) * (low[axis] + 256 * high[axis]) / 65535
            mean.append(math.copysign(math.exp(abs(value)) - 1, value))
        *three, tag = at("quats.webp")
        *color, opacity = at("sh0.webp")
        found.append(
            Splat(
                mean=mean,
                quat=with_largest(tag - 252, [(v / 255 * 2 - 1) / math.sqrt(2) for v in three]),
                log_scale=[meta["scales"]["codebook"][byte] for byte in at("scales.webp")[:3]],
                opacity=opacity / 255,
                sh0=[meta["sh0"]["codebook"][byte] for byte in color],
                rest=sog_rest(meta.get("shN"), at, pixels),
            )
        )
    return found


def sog_rest(rest, at, pixels) -> list[list[float]]:
    if rest is None:
        return []
    first, second, *_ = at("shN_labels.webp")
    label, k = first + 256 * second, {1: 3, 2: 8, 3: 15}[rest["bands"]]
    image = pixels["shN_centroids.webp"]
    return [
        [rest["codebook"][byte] for byte in image.getpixel((label % 64 * k + j, label // 64))[:3]]
        for j in range(k)
    ]


def read_glb(content: bytes) -> list[Splat]:
    """Read a ``.glb`` of one mesh of floats, without a change of axes."""
    size = struct.unpack_from("<I", content, 12)[0]
    document, binary = json.loads(content[20 : 20 + size]), content[28 + size :]
    primitive = document["meshes"][0]["primitives"][0]
    names = {name.rpartition(":")[2]: index for name, index in primitive["attributes"].items()}

    def value(name, row):
        accessor = document["accessors"][names[name]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        start = document["bufferViews"][accessor["bufferView"]].get("byteOffset", 0)
        start += accessor.get("byteOffset", 0) + 4 * width * row
        return list(struct.unpack_from(f"<{width}f", binary, start))

    rest = sorted(name for name in names if re.match("SH_DEGREE_[123]", name))
    found = []
    for row in range(document["accessors"][names["POSITION"]]["count"]):
        x, y, z, w = value("ROTATION", row)
        found.append(
            Splat(
                mean=value("POSITION", row),
                quat=unit([w, x, y, z]),
                log_scale=[math.log(scale) for scale in value("SCALE", row)],
                opacity=value("OPACITY", row)[0],
                sh0=value("SH_DEGREE_0_COEF_0", row),
                rest=[value(name, row) for name in rest],
            )
        )
    return found
