"""What commands that work block by block print about the folder of finished steps."""

import argparse
from pathlib import Path

import pytest

from cvtgs.cli.blocks import block_workers


@pytest.mark.parametrize("has_steps", [True, False])
def test_an_interrupt_says_where_the_finished_steps_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], has_steps: bool
) -> None:
    options = argparse.Namespace(output=tmp_path / "out.ply", scheduler=None, workers=1)
    folder = tmp_path / ".out.ply.blocks"
    if has_steps:
        folder.mkdir()
    with pytest.raises(KeyboardInterrupt), block_workers(options, 10**9):
        raise KeyboardInterrupt
    text = f"cvtgs: {folder.resolve()} has the finished steps, with which the same command "
    assert capsys.readouterr().err.startswith(text) == has_steps
