"""A few damaged files and faults; ``nox -s fuzz`` and ``nox -s faults`` run far more."""

import gzip
import io
import json
import os
import random
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import cvtgs
import fuzz_files
import fuzz_seeds
from cvtgs.errors import FileFormatError
from ply_files import gaussian_properties, gaussian_rows, ply_bytes

HERE = Path(__file__).parents[1]
linux = pytest.mark.skipif(sys.platform != "linux", reason="limits memory as Linux does")


def run_limited(*arguments: str) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([str(HERE), *filter(None, sys.path)])
    return subprocess.run(
        [sys.executable, *arguments],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": path},
    )


@pytest.mark.slow
@linux
def test_damaged_files_give_a_result_or_one_clear_sentence():
    done = run_limited(str(HERE / "fuzz_files.py"), "--count", "3300", "--seed", "1")
    assert (done.returncode, done.stderr) == (0, "")
    ends = {end: int(count) for count, end in re.findall(r"(\d+) ([\w.]+ \w+)", done.stdout)}
    assert sum(ends.values()) == 3300
    assert min(ends["ply read"], ends["ply refused"], ends["config read"]) >= 10


def test_the_same_seed_gives_the_same_damage():
    data = fuzz_seeds.seeds_of_ply()[0]
    first, second = ([fuzz_files.mutant(data, random.Random(s)) for s in range(50)] for _ in "ab")
    assert first == second
    assert len(set(first)) > 40


def test_kept_inputs_give_a_result_or_one_clear_sentence(tmp_path):
    ends = {}
    for kind, found in fuzz_seeds.READERS.items():
        path = fuzz_seeds.place(kind, tmp_path)
        for kept in fuzz_files.corpus(kind):
            path.write_bytes(kept.read_bytes())
            ends[str(kept)] = fuzz_files.verdict(found.read, path)
    assert len(ends) > 50
    assert {kept: end for kept, end in ends.items() if end not in ("read", "refused")} == {}


def test_damaged_boxes_files_are_refused(tmp_path):
    path = tmp_path / "boxes.json"
    path.write_bytes(b"[" * 100_000)
    assert fuzz_files.verdict(fuzz_seeds.READERS["boxes"].read, path) == "refused"
    path.write_text(json.dumps({"min\n" * 1000: 1}))
    assert fuzz_files.verdict(fuzz_seeds.READERS["boxes"].read, path) == "refused"


def test_failing_inputs_are_reduced():
    assert fuzz_files.made_small(b"a" * 500 + b"bug" + b"c" * 300, lambda d: b"bug" in d) == b"bug"
    assert fuzz_files.made_small(b"", lambda data: True) == b""


@pytest.mark.parametrize(
    ("read", "wanted"),
    [
        (lambda path: None, "read"),
        (cvtgs.load, "refused"),
        (lambda path: {}["x"], "KeyError: 'x'"),
        (lambda path: path.with_name("more").touch(), "files were written"),
        (lambda path: bytearray(1 << 62), "more than 1024 MiB"),
        (lambda path: cvtgs.load("elsewhere.ply"), "unclear: "),
    ],
)
def test_the_fuzzer_recognises_every_kind_of_end(tmp_path, read, wanted):
    path = tmp_path / "a.ply"
    path.write_bytes(b"ply")
    assert fuzz_files.verdict(read, path).startswith(wanted)


LISTS = {"face": ([("corners", "list uint int")], [[[0, 1, 2]]])}
PLAIN = gaussian_properties()
WITH_LIST = ply_bytes(PLAIN, gaussian_rows(PLAIN, 2), before=LISTS)
LENGTH_AT = WITH_LIST.index(b"end_header\n") + 11
LYING = {
    "rows": ply_bytes(PLAIN, gaussian_rows(PLAIN, 2)).replace(
        b"vertex 2", b"vertex 400000000000000000"
    ),
    "rows of ascii": ply_bytes(PLAIN, gaussian_rows(PLAIN, 2), encoding="ascii").replace(
        b"vertex 2", b"vertex 400000000000000000"
    ),
    "rows before": WITH_LIST.replace(b"face 1", b"face 400000000000000000"),
    "rows after": ply_bytes(PLAIN, gaussian_rows(PLAIN, 2), after=LISTS).replace(
        b"face 1", b"face 400000000000000000"
    ),
    "list": WITH_LIST[:LENGTH_AT] + b"\xff\xff\xff\x7f" + WITH_LIST[LENGTH_AT + 4 :],
    "empty rows before": ply_bytes(
        PLAIN, gaussian_rows(PLAIN, 2), encoding="ascii", before={"none": ([], [])}
    ).replace(b"none 0", b"none 400000000000000000"),
}


@pytest.mark.long
@linux
def test_false_headers_take_no_memory_and_hangs_are_found(tmp_path):
    for name, data in LYING.items():
        (tmp_path / f"{name}.ply").write_bytes(data)
    program = (
        "import fuzz_files, itertools, pathlib, sys, cvtgs\n"
        "fuzz_files.limit()\n"
        "paths = [pathlib.Path(path) for path in sys.argv[1:]]\n"
        "print(*(fuzz_files.verdict(cvtgs.load, path) for path in paths), sep=', ')\n"
        "fuzz_files.CPU_SECONDS = 0.2\n"
        "spin = lambda path: sum(1 for _ in itertools.count())\n"
        "print(fuzz_files.verdict(spin, paths[0]))\n"
    )
    done = run_limited("-c", program, *(str(tmp_path / f"{name}.ply") for name in LYING))
    ends, hang = done.stdout.splitlines()
    wanted = {"rows after": "read"}
    assert ends.split(", ") == [wanted.get(name, "refused") for name in LYING]
    assert hang == "more than 0.2 s"


def test_false_headers_of_checkpoints_take_no_memory(tmp_path):
    (content,) = fuzz_seeds.seeds_of_checkpoints()
    length = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + length])
    name = next(key for key in header if key != "__metadata__")
    for shape, ends in (([1 << 40], [0, 1 << 42]), ([-1], [0, 4]), ([1 << 62, 1 << 62], [0, 4])):
        entry = {"dtype": "F32", "shape": shape, "data_offsets": ends}
        text = json.dumps(header | {name: entry}).encode()
        path = tmp_path / "lie.safetensors"
        path.write_bytes(len(text).to_bytes(8, "little") + text + content[8 + length :])
        assert fuzz_files.verdict(fuzz_seeds.load_checkpoint, path) == "refused"


@pytest.mark.parametrize(
    "lines",
    [
        [f"element e{i} 99999999\nproperty list uint double p" for i in range(1000)],
        ["element " + "x" * 500_000 + " 1"],
        ["element vertex 1"] + 2 * ["property float " + "x" * 500_000],
    ],
    ids=["a thousand elements", "a long name", "a long name twice"],
)
def test_errors_about_very_long_headers_are_short(tmp_path, lines):
    path = tmp_path / "many.ply"
    path.write_text("\n".join(["ply", "format ascii 1.0", *lines, "end_header", ""]))
    with pytest.raises(FileFormatError) as caught:
        cvtgs.load(path)
    assert len(str(caught.value)) < 400 + len(str(path))


@pytest.mark.parametrize("kind", ["sog", "spz", "state"])
def test_compressed_content_is_damaged_inside(kind):
    seeds = [seed for seed in fuzz_seeds.READERS[kind].seeds() if seed[:2] in (b"PK", b"\x1f\x8b")]
    dice = random.Random(3)
    for seed in seeds:
        damaged = fuzz_files.inside(bytearray(seed), dice)
        if kind == "spz":
            assert gzip.decompress(damaged)
            continue
        with zipfile.ZipFile(io.BytesIO(damaged)) as archive:
            assert archive.testzip() is None
    assert seeds


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="forks and limits as Linux does")
def test_every_fault_leaves_whole_files_or_none():
    """Runs in another process, because forks of a test process would inherit its threads."""
    words = ["--kills", "6", "--pairs", "2", "--limits", "1", "--count", "2000"]
    words += ["--commands", "plain", "blocks", "convert", "--seed", "7"]
    path = os.pathsep.join([str(HERE), *filter(None, sys.path)])
    done = subprocess.run(
        [sys.executable, str(HERE / "faults.py"), *words],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert sum(int(part.split()[0]) for part in done.stdout.split(", ")) == 6 + 2 + 2
