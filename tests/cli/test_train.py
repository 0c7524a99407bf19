"""``cvtgs train`` from end to end, and ``cvtgs simplify --ckpt`` with its checkpoint."""

import json
from pathlib import Path

import pytest
import torch

import cvtgs
from cvtgs.cli.main import main
from cvtgs.errors import MissingDependencyError
from cvtgs.mergenet import encode_checkpoint, load_checkpoint
from cvtgs.train import Gain, History, Validation, loop as train_loop
from train_cases import needs_matplotlib, write_scenes

CONFIG = """
preset = "{preset}"
steps = 3
validate_every = 2
width = 6
cell_width = 10
[data]
folders = [{folders}]
validation = ["exam"]
generated = 0
generated_validation = 0
blocks = 0
ratios = [0.05]
validation_ratios = [0.06, 0.03]
[views]
count = 2
sizes = [32]
validation_count = 2
validation_size = 32
"""

pytestmark = needs_matplotlib


def write_config(folder: Path, *, preset: str = "standard", folders: str = '"scenes"') -> Path:
    path = folder / "tiny.toml"
    path.write_text(CONFIG.format(preset=preset, folders=folders))
    return path


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A folder with scenes, a configuration, and the files that a training wrote."""
    folder = tmp_path_factory.mktemp("made")
    write_scenes(folder / "scenes", ["exam", "lesson"])
    words = ["train", str(write_config(folder)), "-o", str(folder / "net.safetensors"), "--quiet"]
    assert main([*words, "--device", "cpu"]) == 0
    return folder


@pytest.fixture
def again(made, tmp_path) -> list[str]:
    """The arguments of the same training with another output and the existing cache."""
    words = ["train", str(made / "tiny.toml"), "-o", str(tmp_path / "net.safetensors")]
    return [*words, "--cache", str(made / "net.cache"), "--device", "cpu"]


@pytest.mark.slow
def test_all_files_are_beside_the_checkpoint(made):
    names = {path.name for path in made.iterdir()}
    assert names == {
        "scenes",
        "tiny.toml",
        "net.safetensors",
        "net.state",
        "net.png",
        "net.cache",
    }
    assert (made / "net.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert load_checkpoint(made / "net.safetensors").info.preset == "standard"


@pytest.mark.slow
def test_the_summary_says_that_matplotlib_is_missing(again, tmp_path, capsys, monkeypatch):
    def curves(history: History) -> bytes:
        raise MissingDependencyError("charts need matplotlib")

    monkeypatch.setattr(History, "curves", curves)
    assert main(again) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert last == (
        f"{tmp_path / 'net.safetensors'}, no image of its curves, which needs matplotlib; "
        'install it with python -m pip install "cvtgs[plots]"'
    )


@pytest.mark.slow
def test_each_validation_gets_a_line_before_the_summary(again, made, tmp_path, capsys):
    assert main(again) == 0
    printed = capsys.readouterr()
    lines = printed.out.splitlines()
    zero = "+0.00 (lowest +0.00)"
    assert lines[0] == f"step 0: loss -, gain in dB: {zero} at 0.06, {zero} at 0.03"
    assert [line.split(",")[0].rsplit(" ", 1)[0] for line in lines[1:3]] == [
        "step 2: loss",
        "step 3: loss",
    ]
    assert lines[3].startswith("best at step ")
    assert lines[3].endswith(" dB on held-out scenes")
    assert lines[4:] == [f"{tmp_path / 'net.safetensors'}, curves in {tmp_path / 'net.png'}"]
    assert printed.err == ""
    assert (tmp_path / "net.safetensors").read_bytes() == (made / "net.safetensors").read_bytes()
    assert not (tmp_path / "net.cache").exists()


def test_the_lowest_gain_is_printed(capsys):
    from cvtgs.cli.train import print_validation  # noqa: PLC0415

    history = History()
    gains = (Gain("a", 0.1, 1.0), Gain("a", 0.01, 3.0), Gain("b", 0.1, -0.5))
    history.validations.append(Validation(step=7, loss=-1.23456, gains=gains))
    print_validation(history)
    assert capsys.readouterr().out == (
        "step 7: loss -1.235, gain in dB: +0.25 (lowest -0.50) at 0.1, "
        "+3.00 (lowest +3.00) at 0.01\n"
    )


@pytest.mark.slow
def test_quiet_prints_nothing(again, capsys):
    assert main([*again, "--quiet"]) == 0
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("", "")


@pytest.mark.slow
def test_an_existing_checkpoint_is_replaced_only_when_asked(again, made, tmp_path, capsys):
    output = tmp_path / "net.safetensors"
    output.write_text("precious")
    for words in (again, [*again, "--resume"]):
        assert main(words) == 1
        assert "--overwrite" in capsys.readouterr().err
        assert output.read_text() == "precious"
    assert main([*again, "--overwrite", "--quiet"]) == 0
    assert output.read_bytes() == (made / "net.safetensors").read_bytes()


@pytest.mark.parametrize("name", ["net.state", "net.png"])
def test_files_beside_the_checkpoint_are_replaced_only_when_asked(again, tmp_path, capsys, name):
    (tmp_path / name).write_text("precious")
    assert main(again) == 1
    assert f"{name}: the output must not exist yet" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "precious"


@pytest.mark.slow
def test_resume_continues_an_interrupted_training(again, made, tmp_path, capsys, monkeypatch):
    true_step = train_loop._step

    def breaking(state, *arguments) -> float:
        if state.step == 2:
            raise KeyboardInterrupt
        return true_step(state, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(train_loop, "_step", breaking)
        with pytest.raises(KeyboardInterrupt):
            main([*again, "--quiet"])
    assert main([*again, "--resume"]) == 0
    assert capsys.readouterr().out.startswith("step 3: ")
    for name in ("net.safetensors", "net.state", "net.png"):
        assert (tmp_path / name).read_bytes() == (made / name).read_bytes()
    assert main([*again, "--resume"]) == 0
    assert capsys.readouterr().out.startswith("best at step ")


@pytest.mark.slow
def test_resume_without_a_state_says_so_and_starts_a_training(again, made, tmp_path, capsys):
    assert main([*again, "--resume", "--quiet"]) == 0
    found = "there is no such state, so the training starts from the beginning."
    assert capsys.readouterr().err == f"cvtgs: warning: {tmp_path}/net.state: {found}\n"
    assert (tmp_path / "net.state").read_bytes() == (made / "net.state").read_bytes()


@pytest.mark.slow
def test_scenes_can_be_given_on_the_command_line(made, tmp_path, capsys):
    config = write_config(tmp_path, folders="")
    words = ["train", str(config), "-o", str(tmp_path / "net.safetensors"), "--quiet"]
    assert main(words) == 1
    assert "data.validation: no file named exam.ply" in capsys.readouterr().err
    folders = [tmp_path / "exams", tmp_path / "lessons"]
    for folder, name in zip(folders, ("exam", "lesson"), strict=True):
        folder.mkdir()
        (folder / f"{name}.ply").write_bytes((made / "scenes" / f"{name}.ply").read_bytes())
    assert main([*words, "--scenes", str(folders[0]), "--scenes", str(folders[1])]) == 0
    found, wanted = (load_checkpoint(path / "net.safetensors") for path in (tmp_path, made))
    assert found.digest == wanted.digest


@pytest.mark.slow
def test_validation_scenes_and_the_kept_network_can_be_chosen(made, tmp_path, capsys):
    config = tmp_path / "training.toml"
    text = write_config(made).read_text()
    config.write_text('keep = "last"\n' + text.replace('"scenes"', f'"{made / "scenes"}"'))
    words = ["train", str(config), "-o", str(tmp_path / "net.safetensors")]
    assert main([*words, "--validation", "lesson"]) == 0
    assert "last at step 3: " in capsys.readouterr().out
    info = load_checkpoint(tmp_path / "net.safetensors").info
    assert {scene.name: scene.is_validation for scene in info.scenes} == {
        "exam": False,
        "lesson": True,
    }
    assert info.steps == 3
    assert main([*words, "--overwrite", "--validation", "nobody"]) == 1
    assert "data.validation: no file named nobody.ply" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda words: [*words[:3], "net.ckpt"], "net.ckpt: the name must end in .safetensors."),
        (lambda words: [words[0], "none.toml", *words[2:]], "none.toml: cannot be read: No such"),
        (lambda words: [*words, "--scenes", "nowhere"], "data.folders (--scenes): nowhere"),
        (lambda words: [*words, "--device", "abacus"], "device 'abacus' cannot be used here: "),
        (lambda words: [*words[:3], "nowhere/n.safetensors"], "nowhere/n.safetensors: the output"),
    ],
    ids=["suffix", "config", "scenes", "device", "folder"],
)
def test_invalid_arguments_print_one_sentence_and_write_nothing(
    again, tmp_path, capsys, change, text
):
    assert main(change(again)) == 1
    errors = capsys.readouterr().err
    assert errors.startswith(f"cvtgs: error: {text}")
    assert errors.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_wrong_usage_exits_with_2(made, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["train", str(made / "tiny.toml")])
    assert stopped.value.code == 2
    assert "-o" in capsys.readouterr().err


@pytest.fixture
def lively(made, tmp_path) -> Path:
    """The checkpoint of the training, relabelled for the preset paper."""
    checkpoint = load_checkpoint(made / "net.safetensors")
    path = tmp_path / "paper-like.safetensors"
    info = checkpoint.info.model_copy(update={"preset": "paper"})
    path.write_bytes(encode_checkpoint(checkpoint.net, info))
    return path


def simplified(made: Path, tmp_path: Path, *words: str) -> tuple[dict, cvtgs.GaussianScene]:
    source, output = made / "scenes" / "exam.ply", tmp_path / "out.ply"
    report = tmp_path / "report.json"
    common = ["--rho", "0.1", "--report", str(report), "--overwrite", "--quiet"]
    assert main(["simplify", str(source), str(output), *common, *words]) == 0
    return json.loads(report.read_text()), cvtgs.load(output)


def test_simplify_uses_a_checkpoint_file(made, tmp_path):
    path = str(made / "net.safetensors")
    report, small = simplified(made, tmp_path, "--ckpt", path)
    assert (report["checkpoint"], report["config"]["preset"]) == (path, "standard")
    assert len(small) == 60


def test_simplify_uses_the_preset_of_its_checkpoint(made, tmp_path, lively):
    for words, preset in (
        (["--ckpt", str(lively)], "paper"),
        (["--ckpt", "paper"], "paper"),
        (["--ckpt", "standard"], "standard"),
        (["--ckpt", str(lively), "--preset", "standard"], "standard"),
        (["--ckpt", "standard", "--preset", "paper"], "paper"),
        (["--preset", "paper"], "paper"),
        ([], "standard"),
    ):
        report, _ = simplified(made, tmp_path, *words)
        assert report["config"]["preset"] == preset
        assert report["checkpoint"] == (words[1] if "--ckpt" in words else preset)


def test_levels_use_the_preset_of_their_checkpoint(made, tmp_path):
    _, small = simplified(made, tmp_path, "--ckpt", "paper")
    line = ["levels", str(made / "scenes" / "exam.ply"), "-o", str(tmp_path), "--ckpt", "paper"]
    assert main([*line, "--rho", "0.1", "--no-scores", "--quiet"]) == 0
    assert torch.equal(cvtgs.load(tmp_path / "rho_0.1.ply").means, small.means)


def test_simplify_without_a_network(made, tmp_path):
    report, small = simplified(made, tmp_path, "--ckpt", "none")
    assert report["checkpoint"] == "none"
    assert "network" not in {stage["stage"] for stage in report["stages"]}
    assert len(small) == 60


def test_simplify_refuses_bad_checkpoints_in_one_sentence(made, tmp_path, capsys):
    source, output = made / "scenes" / "exam.ply", tmp_path / "out.ply"
    bad = tmp_path / "bad.safetensors"
    bad.write_bytes((made / "net.safetensors").read_bytes()[:-1])
    for name, text in ((str(bad), "damaged"), ("nothing", "no such checkpoint")):
        assert main(["simplify", str(source), str(output), "--rho", "0.1", "--ckpt", name]) == 1
        errors = capsys.readouterr().err
        assert text in errors
        assert errors.count("\n") == 1
        assert not output.exists()
