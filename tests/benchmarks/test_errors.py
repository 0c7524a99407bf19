"""Errors of benchmarks about files and arguments are one sentence, those of programs tracebacks."""

import sys

import pytest

import benchmarks
from cvtgs.errors import InputError


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (InputError("a.ply: must exist."), "error: a.ply: must exist.\n"),
        (ValueError("odd"), "Traceback (most recent call last):"),
    ],
)
def test_errors_of_cvtgs_are_one_sentence(capsys, error, text):
    try:
        raise error
    except (OSError, ValueError):
        kind, found, trace = sys.exc_info()
        vars(benchmarks)["_print_error"](kind, found, trace)
    printed = capsys.readouterr().err
    assert printed.startswith(text)
    assert (printed == text) == isinstance(error, InputError)
