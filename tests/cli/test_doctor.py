"""``cvtgs doctor`` and ``cvtgs --version``: which packages are installed, and do they work."""

import platform
import subprocess
import sys
from importlib import metadata

import pytest
import torch

import cvtgs
from cvtgs.cli import doctor
from cvtgs.cli.doctor import BACKENDS, version_lines, version_of
from cvtgs.cli.main import main


def test_version_lists_the_packages_used_for_computation(capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["--version"])
    lines = capsys.readouterr().out.splitlines()
    assert stopped.value.code == 0
    assert lines[0] == f"cvtgs {cvtgs.__version__}"
    assert lines[1] == f"Python {platform.python_version()}"
    assert [line.split()[0] for line in lines[2:]] == list(BACKENDS)
    assert lines == version_lines()


def test_versions_of_installed_and_missing_packages():
    assert version_of("torch") == metadata.version("torch")
    assert version_of("no-such-package") == "not installed"


def test_version_imports_none_of_the_packages():
    code = (
        "import sys; from cvtgs.cli.doctor import version_lines; version_lines();"
        "print([name for name in ('torch', 'numpy', 'numba') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


@pytest.fixture
def _small(monkeypatch):
    monkeypatch.setattr(doctor, "COUNT", 300)
    monkeypatch.setattr(doctor, "SIDE", 32)


@pytest.mark.usefixtures("_small")
def test_doctor_reports_a_working_machine(capsys):
    assert main(["doctor", "--device", "cpu"]) == 0
    printed = capsys.readouterr().out
    assert "images by torch   yes" in printed
    assert "images by gsplat  no: needs CUDA\n" in printed
    assert "cuda" not in printed.split("images by")[1], "only the CPU was asked for"
    used = "numba" if version_of("numba") != "not installed" else "torch"
    assert f"images by {used:<7} yes (used: the fastest that works here)\n" in printed
    assert printed.count("(used: the fastest") == 1
    assert "nearest sites by scipy (a k-d tree on the host)" in printed
    assert "300 generated Gaussians to 10%" in printed
    for step in ("generate", "simplify", "views", "render"):
        assert f"  {step} " in printed
    ends = "The default path works.\n", f"The default path works.\n{doctor.WITHOUT_OPENMP}\n"
    assert printed.endswith(ends)


@pytest.mark.usefixtures("_small")
@pytest.mark.parametrize("layer", ["omp", "workqueue"])
def test_doctor_says_that_openmp_is_missing(capsys, monkeypatch, layer):
    numba = pytest.importorskip("numba")
    monkeypatch.setattr(numba, "threading_layer", lambda: layer)
    assert main(["doctor", "--device", "cpu"]) == 0
    found = capsys.readouterr().out
    assert ("numba finds no OpenMP" in found) == (layer == "workqueue")
    assert ("libgomp1" in found) == (layer == "workqueue")


@pytest.mark.usefixtures("_small")
def test_every_device_is_checked(capsys):
    assert main(["doctor"]) == 0
    printed = capsys.readouterr().out
    assert "\ncpu: " in printed
    assert printed.count("\ncuda:") == max(1, torch.cuda.device_count())
    assert ("\ncuda: not available: torch" in printed) == (torch.cuda.device_count() == 0)


@pytest.mark.usefixtures("_small")
def test_a_failing_default_path_exits_with_1(capsys, monkeypatch):
    def broken(*words: object, **settings: object) -> None:
        raise RuntimeError("no kernel image is available\nand much more")

    monkeypatch.setattr("cvtgs.simplifier.Simplifier.run", broken)
    assert main(["doctor", "--device", "cpu"]) == 1
    captured = capsys.readouterr()
    assert captured.err == (
        "cvtgs: error: the default path does not work on cpu: no kernel image is available; "
        "try cvtgs doctor --device cpu.\n"
    )
    assert "The default path works." not in captured.out


@pytest.mark.usefixtures("_small")
def test_a_black_image_is_an_error(capsys, monkeypatch):
    monkeypatch.setattr("cvtgs.synthetic.demo_scene", all_black)
    assert main(["doctor", "--device", "cpu"]) == 1
    assert "Gaussians and a mean colour of 0; try" in capsys.readouterr().err


def all_black(count: int, *, sh_degree: int) -> cvtgs.GaussianScene:
    scene = cvtgs.synthetic.scene("object", count, sh_degree=sh_degree, seed=0)
    return scene.with_tensors({"sh0": torch.full_like(scene.sh0, -9.0)}, {})


def test_an_unknown_device_is_refused(capsys):
    assert main(["doctor", "--device", "nowhere"]) == 1
    assert "device 'nowhere' cannot be used here" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("build", "reason"), [(None, "is built for CPUs only"), ("13.0", "no driver for 13.0 or later")]
)
def test_the_reason_why_there_is_no_gpu(build, reason, monkeypatch, capsys):
    monkeypatch.setattr("torch.version.cuda", build)
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert main(["doctor"]) == 0
    assert reason in capsys.readouterr().out
