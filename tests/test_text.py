"""Untrusted texts: escape sequences, unusual names, consoles with other encodings."""

import ast
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import cvtgs
from cvtgs.cli.main import main
from cvtgs.text import columns, first_of, printable, short_repr, shortened, shown, size_text
from ply_files import gaussian_properties, gaussian_rows, ply_bytes

CLI = Path(cvtgs.__file__).parent / "cli"
CLEAR = "\x1b[2J\x1b]0;title\x07"
linux = pytest.mark.skipif(sys.platform != "linux", reason="names of files that are not UTF-8")


def test_size_text():
    assert [size_text(n) for n in (999, 1500, 999_949, 999_999, 68_000_000, 2_000_000_000)] == [
        "999 B",
        "1.5 kB",
        "999.9 kB",
        "1.0 MB",
        "68.0 MB",
        "2.0 GB",
    ]


def test_texts_are_shortened_to_letters_and_to_columns():
    assert shortened("abcdefgh", 8) == "abcdefgh"
    assert shortened("abcdefghi", 8) == "abcde..."
    assert shortened("\u6f22" * 4, 8) == "\u6f22" * 4
    assert shortened("\u6f22" * 5, 8) == "\u6f22\u6f22..."
    assert columns(shortened("\u6f22" * 99, 21)) == 21
    assert len(shortened("a" + "\u0301" * 1000, 8)) == 8


@pytest.mark.parametrize(
    ("text", "encoding", "wanted"),
    [
        ("plain\ttext, \u00fc \u4e2d \U0001f600\n", "utf-8", None),
        (CLEAR, "utf-8", r"\u001b[2J\u001b]0;title\u0007"),
        ("a\rb\x00c\x7fd\x9be", "utf-8", r"a\u000db\u0000c\u007fd\u009be"),
        ("\u202egpj.exe\u2066", "utf-8", r"\u202egpj.exe\u2066"),
        ("sc\udce9ne", "utf-8", r"sc\udce9ne"),
        (
            "sc\u00e9ne \u2013 \u4e2d",
            "cp1252",
            r"sc\u00e9ne \u2013 \u4e2d".replace(r"\u00e9", "\u00e9").replace(r"\u2013", "\u2013"),
        ),
        ("\u00e9 \U0001f600", "ascii", r"\u00e9 \ud83d\ude00"),
    ],
)
def test_printable_escapes_control_and_unencodable_characters(
    text: str, encoding: str, wanted: str | None
) -> None:
    found = printable(text, encoding)
    assert found == (text if wanted is None else wanted)
    assert found.encode(encoding)
    if "\n" not in text:
        assert json.loads(f'"{found}"') == text


@pytest.mark.slow
def test_shown_escapes_and_shortens_values() -> None:
    assert shown("a\x1b") == r"'a\x1b'"
    assert len(shown("x" * 1000)) == 60
    assert len(shown("x" * 1000, 80)) == 80
    assert shown(10**5000) == "a number of thousands of digits"
    nested: list[object] = []
    for _ in range(100_000):
        nested = [nested]
    assert shown(nested) == "a deeply nested list"
    while nested:
        nested = nested[0]  # type: ignore[assignment]


def test_only_one_function_of_the_command_line_prints() -> None:
    found = [
        f"{path.name}:{node.lineno}"
        for path in CLI.glob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ("print", "sys.stdout.write")
    ]
    assert [name.partition(":")[0] for name in found] == ["display.py"]


def write_hostile(path: Path) -> None:
    properties = [*gaussian_properties(), (f"label{CLEAR}", "float")]
    comments = [f"by {CLEAR} \u202e someone", "caf\u00e9"]
    path.write_bytes(ply_bytes(properties, gaussian_rows(properties, 30), comments=comments))


@pytest.mark.parametrize("command", ["info", "convert", "wrong"])
def test_control_characters_do_not_reach_the_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    path = tmp_path / f"a{CLEAR}.ply"
    write_hostile(path)
    if command == "wrong":
        path.write_bytes(b"no ply")
    output = tmp_path / f"b{CLEAR}.spz"
    words = ["convert", str(path), str(output)] if command == "convert" else []
    main(words or ["info", str(path)])
    printed = capsys.readouterr()
    text = printed.out + printed.err
    assert r"\u001b[2J" in text
    assert all(letter.isprintable() or letter == "\n" for letter in text)


def test_json_of_info_keeps_control_characters(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.ply"
    write_hostile(path)
    assert main(["info", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["comments"][0] == f"by {CLEAR} \u202e someone"


def run(encoding: str, *words: str | bytes) -> subprocess.CompletedProcess[bytes]:
    program = "from cvtgs.cli.main import run_process; run_process()"
    return subprocess.run(
        [sys.executable, "-c", program, *words],
        capture_output=True,
        check=False,
        env={**os.environ, "PYTHONIOENCODING": encoding},
    )


@pytest.mark.long
@pytest.mark.parametrize("encoding", ["ascii", "cp1252"])
def test_consoles_with_other_encodings_work(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "caf\u00e9 \u4e2d.ply"
    write_hostile(path)
    done = run(encoding, "info", str(path))
    assert (done.returncode, done.stderr) == (0, b"")
    assert rb"\u4e2d" in done.stdout
    done = run(encoding, "convert", str(path), str(tmp_path / "\u4e2d.spz"))
    assert done.returncode == 0
    assert b"Traceback" not in done.stderr
    done = run(encoding, "\u4e2d")
    assert done.returncode == 2
    assert b"Traceback" not in done.stderr


@pytest.mark.long
@linux
def test_file_names_that_are_not_utf_8_work(tmp_path: Path) -> None:
    path = os.fsencode(tmp_path) + b"/sc\xe9ne.ply"
    write_hostile(Path(os.fsdecode(path)))
    levels, page = tmp_path / "levels", tmp_path / "page"
    done = run("utf-8", "levels", path, "-o", str(levels), "--rho", "0.5", "--no-scores")
    assert (done.returncode, done.stderr) == (0, b"")
    assert json.loads((levels / "levels.json").read_text())["source"] == r"sc\udce9ne.ply"
    words = ["--size", "32", "--views", "1", "--lpips", "off", "--backend", "torch"]
    done = run("utf-8", "compare", path, str(levels / "rho_0.5.ply"), "-o", str(page), *words)
    assert (done.returncode, done.stderr) == (0, b"")
    assert r"sc\udce9ne" in (page / "index.html").read_text().replace("\\\\", "\\")


def test_lists_of_a_file_are_cut_after_ten() -> None:
    assert first_of(["a", "b"]) == "a, b"
    assert first_of(["x" * 99, *"abcdefghijk"], length=9, between="; ") == (
        "xxxxxx...; a; b; c; d; e; f; g; h; i; and 2 more"
    )
    assert first_of([]) == ""


def test_long_lists_of_a_file_are_not_printed_whole(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    properties = [*gaussian_properties(), *((f"{'x' * 50}{k}", "float") for k in range(500))]
    comments = ["y" * 9000] * 50
    path = tmp_path / "a.ply"
    path.write_bytes(ply_bytes(properties, gaussian_rows(properties, 30), comments=comments))
    for words in (["info", str(path)], ["convert", str(path), str(tmp_path / "b.spz")]):
        assert main(words) == 0
        assert len("".join(capsys.readouterr())) < 6000


def test_a_line_feed_in_a_name_starts_no_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a\ncvtgs: error: b.ply"
    path.write_bytes(b"no ply")
    assert main(["info", str(path)]) == 1
    assert capsys.readouterr().err.count("\n") == 1


def test_a_short_repr_has_shapes_and_hides_long_values():
    @dataclass(repr=False)
    class Thing:
        name: str
        values: object
        number: object
        lines: object
        long: object

        __repr__ = short_repr

    number = np.float32(2.0)  # numpy 1 and 2 show it in two ways
    thing = Thing("a", np.zeros((2, 3)), number, Lines(), ["a" * 500])
    assert repr(thing).endswith(
        f"Thing(name='a', values=float64 (2, 3), number={number!r}, lines=Lines, long=list)"
    )


class Lines:
    def __repr__(self) -> str:
        return "a\nb"
