"""Arguments of runs in blocks: wrong ones are named before any file is made."""

from typing import Any

import numpy as np
import pytest

import cvtgs
from cvtgs import Simplifier
from cvtgs.errors import InvalidArgumentError
from cvtgs.outofcore import simplify_file
from cvtgs.outofcore.memory import LEAST_BYTES
from cvtgs.streams import stream_file
from scenes import random_scene

WRONG: list[tuple[str, Any, str]] = [
    ("blocks", 0, "blocks must be a whole number above 0, found 0."),
    ("blocks", -3, "blocks must be a whole number above 0, found -3."),
    ("blocks", 2.7, "blocks must be a whole number above 0, found 2.7."),
    ("blocks", "3", "blocks must be a whole number above 0, found '3'."),
    ("sh_degree", 5, "sh_degree must be a whole number between 0 and 3, found 5."),
    ("sh_degree", "1", "sh_degree must be a whole number between 0 and 3, found '1'."),
    ("workers", 3, "workers must be of type Workers or None, found int."),
    ("listener", 3, "listener must be a function of a progress event, found 3."),
    ("simplifier", "fast", "simplifier must be of type Simplifier or None, found str."),
    ("memory", 10**6, f"memory must be at least {LEAST_BYTES / 1e6:g} MB: torch and scipy take "),
    ("memory", 2.5, "memory must be a whole number of bytes above 0, found 2.5."),
    ("memory", "4GB", "memory must be a whole number of bytes above 0, found '4GB'."),
]
WRONG_OF_FILES: list[tuple[str, Any, str]] = [
    *WRONG,
    ("range_rows", 0, "range_rows must be a whole number above 0, found 0."),
    ("range_rows", -5, "range_rows must be a whole number above 0, found -5."),
    ("range_rows", 2.5, "range_rows must be a whole number above 0, found 2.5."),
    ("boxes", "abc", "boxes must be of type Box, found 'a'."),
    ("boxes", None, "boxes must be of type Box, found None."),
]


@pytest.fixture
def source(tmp_path):
    cvtgs.save(random_scene(300), tmp_path / "in.ply")
    return tmp_path / "in.ply"


def options(name: str, value: object) -> dict[str, Any]:
    return {"blocks": 2, "simplifier": Simplifier(preset="draft", device="cpu"), name: value}


@pytest.mark.parametrize(("name", "value", "message"), WRONG_OF_FILES)
def test_wrong_arguments_of_a_file_are_named(source, name, value, message):
    with pytest.raises(InvalidArgumentError) as caught:
        simplify_file(source, source.with_name("out.ply"), 0.1, **options(name, value))
    assert str(caught.value).startswith(message)
    assert list(source.parent.iterdir()) == [source]


@pytest.mark.parametrize(("name", "value", "message"), WRONG)
def test_wrong_arguments_of_a_stream_are_named(source, name, value, message):
    more = options(name, value)
    with pytest.raises(InvalidArgumentError) as caught:
        stream_file(source, source.with_name("out"), [1.0, 0.1], kind="sog", **more)
    assert str(caught.value).startswith(message)
    assert list(source.parent.iterdir()) == [source]


@pytest.mark.parametrize("axes", [None, 5, "rdf", ("rdf",)])
def test_axes_of_a_stream_are_two(source, axes):
    with pytest.raises(InvalidArgumentError, match="axes must be those of the input file and tho"):
        stream_file(source, source.with_name("out"), [1.0, 0.1], kind="sog", axes=axes)


def test_the_source_is_a_path(source):
    with pytest.raises(InvalidArgumentError, match="a path must be a str or Path, found NoneType"):
        simplify_file(None, source.with_name("out.ply"), 0.1)


@pytest.mark.slow
def test_numbers_may_be_of_numpy(source):
    numbers = {"blocks": 2, "memory": 10**9, "sh_degree": 0, "range_rows": 100}
    for name, change in {"own": int, "numpy": np.int64}.items():
        more = {key: change(number) for key, number in numbers.items()}
        simplify_file(source, source.with_name(f"{name}.ply"), 0.1, **more)
    assert source.with_name("numpy.ply").read_bytes() == source.with_name("own.ply").read_bytes()


def test_ratios_of_a_stream_may_come_one_by_one(source):
    report = stream_file(source, source.with_name("out"), iter([1.0, 0.1]), kind="sog", blocks=2)
    assert [level.gaussians for level in report.levels] == [300, 30]
    with pytest.raises(InvalidArgumentError, match=r"ratios must be a list of numbers, found 0.5"):
        stream_file(source, source.with_name("other"), 0.5, kind="sog", blocks=2)
