"""Large files in blocks: the tables of workers and of seams."""

import json
import math
import sys
from pathlib import Path

import pytest
import torch

import cvtgs
from benchmarks import cameras, large
from benchmarks.measuring import Cost


def test_workers_are_compared(tmp_path, monkeypatch, capsys):
    """Two workers take half the time, three write something else."""

    def simplify(*words: str) -> Cost:
        workers = int(words[words.index("--workers") + 1])
        Path(words[words.index("simplify") + 2]).write_bytes(b"3" if workers == 3 else b"1")
        assert words[words.index("--memory") + 1] == str(workers * 2 * 10**9)
        report = {"output_count": 1000, "blocks": 4}
        Path(words[words.index("--report") + 1]).write_text(json.dumps(report))
        return Cost(user_seconds=1.0, wall_seconds=8.0 / workers, peak_bytes=5 * 10**6, output="")

    scene = tmp_path / "scene.ply"
    scene.write_bytes(b"0" * 10**7)
    words = ["large", "blocks", str(scene), "--workers", "1", "2", "3"]
    monkeypatch.setattr(sys, "argv", words)
    monkeypatch.setattr(large, "run_python", simplify)
    large.main()
    lines = capsys.readouterr().out.splitlines()[-3:]
    start, end = "| scene, 0.01 GB | 2GB |", "| 5 | 1,000 | 4 |"
    assert lines == [
        f"{start} 1 | 1.0 | 8.0 | 1.00, same bytes {end}",
        f"{start} 2 | 1.0 | 4.0 | 2.00, same bytes {end}",
        f"{start} 3 | 1.0 | 2.7 | 3.00, DIFFERENT bytes {end}",
    ]


@pytest.mark.long
@pytest.mark.parametrize("has_cameras", [True, False])
def test_seams_are_scored_by_the_cameras_beside_a_file(tmp_path, monkeypatch, capsys, has_cameras):
    """And the others, six of which are given, score nothing."""
    scene = cvtgs.synthetic.scene("object", 300, sh_degree=0, seed=0)
    file, calls, seen = tmp_path / "a.ply", [], []
    cvtgs.save(scene, file)
    if has_cameras:
        cameras.main([str(file)])

    def simplify(_, output, rho: float, **options) -> None:
        calls.append((rho, options["blocks"], len(options["cameras"])))
        cvtgs.save(scene[:30], output, overwrite=True)

    def noted(full, small, views) -> dict:
        seen.append(len(views))
        return score_views(full, small, views)

    score_views = large.score_views
    monkeypatch.setattr(large, "simplify_file", simplify)
    monkeypatch.setattr(large, "score_views", noted)
    words = ["large", "seams", str(file), "--exact", "--fit", "6", "--blocks", "2", "--rho", "0.2"]
    monkeypatch.setattr(sys, "argv", words)
    large.main()
    assert calls == [(0.2, 2, 6)]
    assert seen == [12 if has_cameras else 6] * 2
    name, preset, whole, blocks = capsys.readouterr().out.splitlines()[-1].strip("| ").split(" | ")
    assert (name, preset) == ("a, 300", "standard")
    assert float(whole.split()[0]) > 0 > float(blocks.split()[0])


def test_blocks_without_files_simplify_a_generated_one(monkeypatch, capsys):
    def simplify(*words: str) -> Cost:
        place = words.index("simplify")
        assert len(cvtgs.load(words[place + 1])) == 2000
        Path(words[place + 2]).write_bytes(b"1")
        Path(words[words.index("--report") + 1]).write_text('{"output_count": 20, "blocks": 1}')
        return Cost(user_seconds=1.0, wall_seconds=1.0, peak_bytes=10**6, output="")

    monkeypatch.setattr(large, "run_python", simplify)
    monkeypatch.setattr(sys, "argv", ["large", "blocks", "--count", "2000"])
    large.main()
    assert capsys.readouterr().out.splitlines()[-1].startswith("| courtyard_2k_sh0, 0.00 GB |")


def test_make_needs_a_file(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["large", "make"])
    with pytest.raises(SystemExit, match=r"make must have one file to write; found 0\."):
        large.main()


def test_levels_of_small_scenes(monkeypatch, capsys):
    monkeypatch.setattr(torch, "set_num_threads", lambda _: None)
    monkeypatch.setattr(large, "RUNS", 1)
    monkeypatch.setattr(sys, "argv", ["large", "levels", "--count", "300", "--kinds", "object"])
    large.main()
    assert capsys.readouterr().out.splitlines()[-1].startswith("| object, 300 | ")


@pytest.mark.slow
def test_seams_where_nearly_all_is_kept(monkeypatch, capsys):
    """Images without any error have no difference, and no ratio is above 1."""
    rhos = []

    def simplify(path, output, rho: float, **_) -> None:
        rhos.append(rho)
        cvtgs.save(cvtgs.load(path), output, overwrite=True)

    monkeypatch.setattr(large, "simplify_file", simplify)
    monkeypatch.setattr(large, "scores", lambda *_: (math.inf, 1.0))
    words = ["--count", "100", "--kinds", "object", "--rho", "1", "--blocks", "2"]
    monkeypatch.setattr(sys, "argv", ["large", "seams", *words])
    large.main()
    assert rhos == [0.97, 0.985, 1.0, 1.0, 1.0]
    assert capsys.readouterr().out.splitlines()[-1].endswith("| inf (1.0000) | +0.00 (+0.0000) |")


@pytest.mark.long
def test_streams_in_blocks_are_compared_with_one_piece(monkeypatch, capsys):
    words = ["large", "seams", "--stream", "--exact", "--kinds", "object", "--count", "1500"]
    words += ["--blocks", "1,3", "--presets", "draft", "--rho", "0.2"]
    monkeypatch.setattr(sys, "argv", words)
    large.main()
    *_, whole, same, blocks = capsys.readouterr().out.splitlines()[-1].strip("| ").split(" | ")
    assert float(whole.split()[0]) > 10
    assert same == "+0.00 (+0.0000)"
    assert blocks != same
