"""The command line as a whole: help, usage, errors, exit codes, interruption."""

import errno
import io
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import cvtgs
from cvtgs.cli.main import build_parser, main
from cvtgs.cli.options import PRESET_NAMES


def run_cvtgs(*arguments: str | Path, **options) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "cvtgs", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)


def test_help_names_every_command(capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["--help"])
    assert stopped.value.code == 0
    printed = capsys.readouterr().out
    for command in ("simplify", "info", "demo", "doctor"):
        assert command in printed


def test_help_names_every_preset_in_order():
    names = re.sub(r"\(.*?\) or", "", PRESET_NAMES)
    assert re.findall(r"\w+", names) == list(cvtgs.PRESETS), "see PRESET_NAMES in cli/options.py"


def test_version_starts_with_that_of_cvtgs(capsys):
    with pytest.raises(SystemExit):
        main(["--version"])
    assert capsys.readouterr().out.startswith(f"cvtgs {cvtgs.__version__}\n")


def test_help_imports_no_heavy_package():
    code = (
        "import sys; from cvtgs.cli.main import build_parser; build_parser().format_help();"
        "print([name for name in ('torch', 'numpy', 'scipy', 'rich') if name in sys.modules])"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout == "[]\n"


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["unknown"],
        ["simplify", "in.ply", "out.ply"],
        ["simplify", "in.ply", "out.ply", "--rho", "0.1", "--count", "5"],
        ["simplify", "in.ply", "out.ply", "--rho", "many"],
        ["simplify", "in.ply", "out.ply", "--count", "1.5"],
    ],
)
def test_wrong_usage_exits_with_2(words, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(words)
    assert stopped.value.code == 2
    assert "usage: cvtgs" in capsys.readouterr().err


def test_without_a_command_the_help_is_printed(capsys):
    with pytest.raises(SystemExit) as stopped:
        main([])
    assert stopped.value.code == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err == build_parser().format_help()


@pytest.mark.parametrize(
    ("words", "end"),
    [
        (["simplif", "in.ply", "out.ply"], "; did you mean simplify?\n"),
        (["simplify", "in.ply", "out.ply", "--rhoo=0.1"], ": --rhoo; did you mean --rho?\n"),
        (["evaluate", "a.ply", "b.ply", "--backend", "numbaa"], "; did you mean numba?\n"),
        (["info", "a.ply", "--zzz"], "unrecognized argument: --zzz\n"),
        (["simplify", "a.ply", "b.ply", "-rho", "1"], ": -rho; did you mean --rho?\n"),
        (["render", "a.ply", "-o", "d", "-overwrite"], ": -overwrite; did you mean --overwrite?\n"),
        *(
            (
                ["simplify", "in.ply", "out.ply", "--rho", rho],
                f"argument --rho: rho must be above 0 and at most 1 (100%), found '{rho}'\n",
            )
            for rho in ("150%", "0", "nan", "1.5")
        ),
        *(
            (
                [command, "a.ply", "-o", "d", "--rho", "0.1,x"],
                "argument --rho: a ratio must be a number such as 0.05 or 5%, found 'x'\n",
            )
            for command in ("levels", "tradeoff")
        ),
        (
            ["levels", "a.ply", "-o", "d", "--rho", "0.1,10%"],
            "argument --rho: must be different numbers separated by commas, for example 0.1,0.01 "
            "or 10%,1%; found '0.1,10%'\n",
        ),
        (
            ["levels", "a.ply", "-o", "d", "--rho", "0"],
            "argument --rho: rho must be above 0 and at most 1 (100%), found '0'\n",
        ),
        (
            ["simplify", "a.ply", "b.ply", "--rho", "1", "--workers", "x"],
            "argument --workers: must be a whole number, found 'x'\n",
        ),
        (
            ["simplify", "a.ply", "b.ply", "--rho", "1", "--refine-steps", "1.5"],
            "argument --refine-steps: must be a whole number, found '1.5'\n",
        ),
        (
            ["simplify", "a.ply", "b.ply", "--rho", "1", "--refine", "x"],
            "argument --refine: must be a time in ms, s, min or h, for example 20s or 2m, found "
            "'x'\n",
        ),
        (
            ["simplify", "a.ply", "b.ply", "--rho", "1", "--report", "d/"],
            "argument --report: must be a file, found the folder 'd/'\n",
        ),
        (["info", "a.ply", "b.ply"], "cvtgs info: error: unrecognized arguments: b.ply\n"),
        (
            ["levels", "a.ply", "-o", "l", "--rho", "0.1", "0.01"],
            "unrecognized arguments: 0.01; separate ratios by commas: --rho 0.1,0.01\n",
        ),
    ],
)
def test_mistyped_words_get_a_suggestion(words, end, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(words)
    assert stopped.value.code == 2
    assert capsys.readouterr().err.endswith(end)


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--set", "iterations=3"], "iterations: is not a known setting; did you mean cvt.iterat"),
        (["--set", "refine.rates.mean=0"], "did you mean refine.rates.means?"),
        (["--effects", "hase=on"], "effects.hase: is not a known setting; did you mean effects.ha"),
        (["--set", "nothing.like=it"], "nothing: is not a known setting.\n"),
    ],
)
def test_mistyped_settings_get_a_suggestion(words, text, capsys):
    assert main(["simplify", "in.ply", "out.ply", "--rho", "0.1", *words]) == 1
    assert text in capsys.readouterr().err


def test_options_may_be_shortened_and_files_may_have_odd_names(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["info", "--js", "--", "--missing.ply"]) == 1
    assert capsys.readouterr().err.startswith("cvtgs: error: --missing.ply: ")


def test_an_error_is_one_sentence_on_stderr(tmp_path, capsys):
    missing = tmp_path / "missing.ply"
    assert main(["info", str(missing)]) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith(f"cvtgs: error: {missing}: ")
    assert captured.err.count("\n") == 1


def test_each_call_builds_a_new_parser():
    assert build_parser() is not build_parser()


@pytest.mark.long
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_signal_leaves_no_output_behind(tmp_path, name):
    number = getattr(signal, name)
    source = tmp_path / "in.ply"
    cvtgs.save(cvtgs.synthetic.scene("object", 400_000, sh_degree=0, seed=0), source)
    output = tmp_path / "out.ply"
    command = [sys.executable, "-m", "cvtgs", "simplify", source, output, "--rho", "0.05"]
    settings = ["--set", "cvt.iterations=1000", "--set", "cvt.tolerance=0"]
    settings += ["--set", "cvt.samples_per_site=0"]
    with subprocess.Popen([*command, *settings], stderr=subprocess.PIPE, text=True) as process:
        wait_for_handler(process.pid, number)
        process.send_signal(number)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 128 + number
    assert "Traceback" not in errors
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in.ply"]


def wait_for_handler(pid: int, number: int) -> None:
    """Wait until the process handles the signal and its computation has started."""
    status = Path(f"/proc/{pid}/status")
    if not status.exists():
        pytest.skip("needs /proc to see when a process catches signals")
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        lines = status.read_text().splitlines()
        caught = int(next(line for line in lines if line.startswith("SigCgt")).split()[1], 16)
        threads = int(next(line for line in lines if line.startswith("Threads")).split()[1])
        if caught >> (number - 1) & 1 and threads > 1:
            time.sleep(1.0)
            return
        time.sleep(0.05)
    raise TimeoutError("the process never caught the signal")


@pytest.mark.long
def test_an_error_of_python_m_cvtgs_prints_no_traceback():
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    result = run_cvtgs("info", "missing.ply", env=environment)
    assert result.returncode == 1
    assert "Traceback" not in result.stderr


full_disk = pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")


@pytest.fixture(params=["buffered", "unbuffered"])
def buffering(request, monkeypatch):
    """Python writes to files and pipes at the end of a process, or at once if told so."""
    monkeypatch.delenv("PYTHONUNBUFFERED", raising=False)
    if request.param == "unbuffered":
        monkeypatch.setenv("PYTHONUNBUFFERED", "1")


@pytest.mark.long
@full_disk
@pytest.mark.usefixtures("buffering")
@pytest.mark.parametrize(
    "words",
    [["info", "a.ply"], ["--version"], ["info", "--help"], ["convert", "a.ply", "-", "--quiet"]],
)
def test_a_full_disk_behind_stdout_is_reported_in_one_sentence(tmp_path, words):
    cvtgs.save(cvtgs.synthetic.scene("object", 20, sh_degree=0, seed=0), tmp_path / "a.ply")
    with Path("/dev/full").open("w") as full:
        done = run_into(full, tmp_path, *words)
    assert done.returncode == 1
    assert done.stderr == (
        "cvtgs: error: standard output must be writable, found: no space left on device.\n"
    )


def run_into(stdout, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "cvtgs", *words]
    return subprocess.run(
        command, stdout=stdout, stderr=subprocess.PIPE, text=True, check=False, cwd=folder
    )


@pytest.mark.slow
@full_disk
@pytest.mark.usefixtures("buffering")
@pytest.mark.parametrize(("words", "status"), [(["info", "no.ply"], 1), (["simplify"], 2)])
def test_an_unwritable_stderr_does_not_change_the_exit_status(tmp_path, words, status):
    with Path("/dev/full").open("w") as full:
        command = [sys.executable, "-m", "cvtgs", *words]
        done = subprocess.run(command, stderr=full, check=False, cwd=tmp_path)
    assert done.returncode == status


def test_a_reader_that_ends_is_no_error_on_windows(monkeypatch, capsys):
    class Pipe(io.StringIO):
        def write(self, text):
            raise OSError(errno.EINVAL, "Invalid argument")

    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(sys, "stdout", Pipe())
    assert main(["completion", "bash"]) == 141
    assert capsys.readouterr().err == ""


@pytest.mark.skipif(os.name != "posix", reason="closes pipes as POSIX does")
@pytest.mark.usefixtures("buffering")
@pytest.mark.parametrize(
    "words",
    [
        ["--version"],
        pytest.param(["convert", "a.ply", "-", "--quiet"], marks=pytest.mark.slow),
    ],
)
def test_a_closed_pipe_exits_with_141_and_no_message(tmp_path, words):
    cvtgs.save(cvtgs.synthetic.scene("object", 20, sh_degree=0, seed=0), tmp_path / "a.ply")
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as closed:
        done = run_into(closed, tmp_path, *words)
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.long
@pytest.mark.skipif(os.name != "posix", reason="closes streams as POSIX shells do")
def test_streams_that_the_parent_closed(tmp_path):
    cvtgs.save(cvtgs.synthetic.scene("object", 200, sh_degree=0, seed=0), tmp_path / "a.ply")

    def run(words: str) -> subprocess.CompletedProcess[str]:
        line = f"{sys.executable} -m cvtgs {words}"
        return subprocess.run(
            ["sh", "-c", line], capture_output=True, text=True, check=False, cwd=tmp_path
        )

    assert run("convert a.ply - 2>&- >b.ply").returncode == 0
    assert (tmp_path / "b.ply").read_bytes() == (tmp_path / "a.ply").read_bytes()
    assert run("simplify a.ply c.ply --rho 0.1 --preset draft 2>&-").returncode == 0
    for words, stream in (("info - <&-", "input"), ("convert a.ply - >&-", "output")):
        done = run(words)
        assert done.returncode == 1
        assert done.stderr == (
            f"cvtgs: error: standard {stream} must be a pipe or a file, found none.\n"
        )


def test_only_some_commands_read_standard_input(capsys):
    assert main(["evaluate", "-", "a.ply"]) == 1
    assert "simplify, convert and info read standard input (-)." in capsys.readouterr().err


def test_all_folders_that_a_failed_command_made_are_removed(tmp_path, capsys):
    cvtgs.save(cvtgs.synthetic.scene("object", 20, sh_degree=0), tmp_path / "a.ply")
    (tmp_path / "bad.ply").write_text("bad")
    words = ["convert", str(tmp_path / "bad.ply"), "-o", str(tmp_path / "n" / "m" / "o")]
    assert main(words) == 1
    assert not (tmp_path / "n").exists()
    capsys.readouterr()


def test_a_signal_ignored_in_a_destructor_is_sent_again(tmp_path, monkeypatch, capsys):
    class Deaf:
        def __del__(self):
            signal.raise_signal(signal.SIGINT)

    def run(options):
        Deaf()  # Python ignores exceptions in __del__
        deadline = time.monotonic() + 30
        while time.monotonic() < deadline:
            time.sleep(0.01)
        raise AssertionError("went on")

    monkeypatch.setattr("cvtgs.cli.files.show_info", run)
    assert main(["info", "a.ply"]) == 130
    assert capsys.readouterr().err == "cvtgs: interrupted; no incomplete file is left.\n"


def test_an_interrupt_waits_until_torch_is_loaded(monkeypatch, capsys):
    done = []

    def load():
        signal.raise_signal(signal.SIGINT)
        done.append("loaded")

    monkeypatch.setattr("cvtgs.cli.main.load_torch", load)
    monkeypatch.setattr("cvtgs.cli.files.show_info", done.append)
    assert main(["info", "a.ply"]) == 130
    assert done == ["loaded"]
    assert capsys.readouterr().err == "cvtgs: interrupted; no incomplete file is left.\n"


def test_an_interrupt_turned_into_another_error_stays_one(monkeypatch, capsys):
    def run(options):
        try:
            signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt as error:
            raise cvtgs.errors.FileFormatError("of a library.") from error

    monkeypatch.setattr("cvtgs.cli.files.show_info", run)
    assert main(["info", "a.ply"]) == 143
    assert capsys.readouterr().err == ""


@pytest.mark.skipif(os.name != "posix", reason="sends signals as POSIX does")
def test_an_interrupt_during_import_prints_no_traceback(tmp_path):
    """An import hook sends the signal at the first import of the command line."""
    (tmp_path / "cvtgs_stop.py").write_text(
        "import signal, sys\n"
        "class Stop:\n"
        "    def find_spec(self, name, *rest):\n"
        "        if name == 'cvtgs.cli':\n"
        "            signal.raise_signal(signal.SIGINT)\n"
        "sys.meta_path.insert(0, Stop())\n"
    )
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import cvtgs_stop; "
    code += "import cvtgs.__main__ as start; start.run()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (130, "cvtgs: interrupted; nothing was written.\n")
