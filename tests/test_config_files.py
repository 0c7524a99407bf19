"""Configurations in files: TOML, and the reports of earlier runs."""

import json

import pytest

from cvtgs import Simplifier, SimplifyConfig
from cvtgs.cli.main import main
from cvtgs.errors import ConfigError
from scenes import random_scene


def compose_error(**values):
    with pytest.raises(ConfigError) as caught:
        SimplifyConfig.compose(**values)
    return str(caught.value)


def test_a_file_that_is_missing_or_not_toml_is_an_error(tmp_path):
    missing, broken, binary = (tmp_path / name for name in ("a.toml", "b.toml", "c.toml"))
    broken.write_text("cvt = [", encoding="utf-8")
    binary.write_bytes(b"\xff\xfe\x00")
    assert compose_error(file=missing) == f"{missing}: cannot be read: No such file or directory."
    for path in (broken, binary):
        assert compose_error(file=path).startswith(f"{path}: is not a TOML file: ")


def test_the_configuration_of_a_report_repeats_its_run(tmp_path):
    changed = SimplifyConfig.compose(preset="fast", settings={"cvt.color": "0.2", "seed": "3"})
    _, report = Simplifier(None, config=changed, device="cpu").run(random_scene(60), 0.5)
    path = tmp_path / "report.JSON"
    path.write_text(report.to_json(), encoding="utf-8")
    assert SimplifyConfig.compose(file=path) == changed == SimplifyConfig.from_toml(path)
    assert SimplifyConfig.compose(file=path, settings={"seed": "4"}).seed == 4


def test_a_report_is_a_configuration_on_the_command_line(tmp_path):
    from cvtgs import load, save  # noqa: PLC0415

    save(random_scene(60), tmp_path / "in.ply")
    words = ["simplify", str(tmp_path / "in.ply"), "--rho", "0.5", "--quiet"]
    first, second, report = (tmp_path / name for name in ("a.ply", "b.ply", "r.json"))
    more = ["--preset", "fast", "--set", "cvt.color=0.3", "--report", str(report)]
    assert main([*words[:2], str(first), *words[2:], *more]) == 0
    assert main([*words[:2], str(second), *words[2:], "--config", str(report)]) == 0
    assert first.read_bytes() == second.read_bytes()
    assert len(load(second)) == 30


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "is not a JSON file: Expecting"),
        ("[]", "must be a report with a config, or a TOML file"),
        (json.dumps({"config": 3}), "must be a report with a config, or a TOML file"),
        (json.dumps({"config": {"sede": 3}}), "sede: is not a known setting"),
        ("[" * 100_000, "is not a JSON file: its values are nested too deeply"),
    ],
)
def test_other_json_is_refused(tmp_path, text, message):
    path = tmp_path / "r.json"
    path.write_text(text, encoding="utf-8")
    found = compose_error(file=path)
    assert found.startswith(f"{path}: {message}")
    assert len(found) < 400
