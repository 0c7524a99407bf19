"""Large files in blocks: the table of workers."""

import json
import sys
from pathlib import Path

from benchmarks import large
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
