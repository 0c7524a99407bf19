"""The choice of a backend, absent packages, and what importing the renderer loads."""

import math
import sys
import threading
import tomllib
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
from packaging.requirements import Requirement

from cvtgs.cameras import Cameras
from cvtgs.errors import DeviceError, InvalidArgumentError
from cvtgs.progress import ProgressEvent
from cvtgs.rendering import choose_backend, contributions, observe, render
from process_cases import python
from scenes import random_scene

ROOT = Path(__file__).parents[2]
CAMERAS = Cameras(
    viewmats=torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]])[None],
    Ks=torch.tensor([[[8.0, 0, 4], [0, 8, 3], [0, 0, 1]]]),
    width=8,
    height=6,
)


def test_auto_takes_numba_on_a_cpu_if_it_is_there():
    wanted = "numba" if find_spec("numba") else "torch"
    assert choose_backend("auto", torch.device("cpu"))[0] == wanted
    assert render(random_scene(3), CAMERAS).backend == wanted


def test_auto_takes_torch_on_other_devices():
    assert choose_backend("auto", torch.device("meta"))[0] == "torch"


@pytest.mark.parametrize("name", ["numba", "gsplat"])
def test_backends_name_the_device_that_they_need(name):
    if name == "numba" and not find_spec("numba"):
        pytest.skip("numba is not installed")
    needed = {"numba": "the CPU", "gsplat": "CUDA"}[name]
    with pytest.raises(DeviceError) as caught:
        choose_backend(name, torch.device("meta"))
    assert str(caught.value) == (
        f"backend '{name}' works on {needed} only, found a scene on meta; "
        f"use 'torch' or 'auto', or move the scene."
    )


def test_an_unknown_backend_is_refused():
    with pytest.raises(InvalidArgumentError) as caught:
        choose_backend("cuda", torch.device("cpu"))
    assert str(caught.value) == "backend must be one of auto, torch, numba, gsplat, found 'cuda'."


@pytest.mark.long
def test_without_numba_auto_takes_torch_and_numba_is_refused():
    lines = python(
        "import sys\n"
        "sys.modules['numba'] = None\n"
        "import torch\n"
        "from cvtgs.errors import MissingDependencyError\n"
        "from cvtgs.rendering import choose_backend\n"
        "cpu = torch.device('cpu')\n"
        "print(choose_backend('auto', cpu)[0])\n"
        "try:\n"
        "    choose_backend('numba', cpu)\n"
        "except MissingDependencyError as error:\n"
        "    print(error)\n"
    )
    assert lines == [
        "torch",
        "backend 'numba' needs the package numba, which cannot be imported "
        "(import of numba halted; None in sys.modules); "
        "install it with python -m pip install numba, or use backend='torch'.",
    ]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="needs a limit of memory")
def test_without_memory_for_numba_no_other_backend_is_chosen():
    pytest.importorskip("numba")
    lines = python(
        "import re, resource, torch\n"
        "from cvtgs.rendering import choose_backend\n"
        "status = open('/proc/self/status').read()\n"
        "room = 1024 * int(re.search(r'VmSize:\\s+(\\d+) kB', status)[1]) + (20 << 20)\n"
        "resource.setrlimit(resource.RLIMIT_AS, (room, room))\n"
        "try:\n"
        "    print(choose_backend('auto', torch.device('cpu'))[0])\n"
        "except MemoryError:\n"
        "    print('no memory')\n"
    )
    assert lines == ["no memory"]


@pytest.mark.long
def test_kernels_work_without_a_folder_for_compiled_code():
    pytest.importorskip("numba")
    lines = python(
        "from numba.core import caching\n"
        "caching.CacheImpl._locator_classes = []\n"
        "from cvtgs.rendering.compiled import serial\n"
        "print(serial(lambda number: number + 1)(2))\n"
    )
    assert lines == ["3"]


@pytest.mark.long
def test_threads_of_torch_and_numba_stay_as_they_are(monkeypatch):
    pytest.importorskip("numba")
    monkeypatch.setenv("NUMBA_NUM_THREADS", "2")
    lines = python(
        "import numba, torch\n"
        "from cvtgs.rendering.compiled import threads_of_torch\n"
        "for count in (1, 2, 3):\n"
        "    torch.set_num_threads(count)\n"
        "    with threads_of_torch():\n"
        "        print(torch.get_num_threads(), numba.get_num_threads())\n"
        "print(torch.get_num_threads(), numba.get_num_threads())\n"
    )
    assert lines == ["1 1", "2 2", "3 2", "3 2"]


@pytest.mark.long
def test_threads_can_render_at_the_same_time_without_openmp():
    """As on machines without its library (libgomp1, absent in slim images of Docker)."""
    pytest.importorskip("numba")
    program = (
        "import numba, threading, torch\n"
        "from cvtgs import render, synthetic, views\n"
        "torch.set_num_threads(2)\n"
        "scene = synthetic.scene('object', 2000, sh_degree=0)\n"
        "cameras = views.automatic_views(scene, 8, width=96, height=64)\n"
        "started = [threading.Thread(target=render, args=(scene, cameras)) for _ in range(6)]\n"
        "for thread in started: thread.start()\n"
        "for thread in started: thread.join()\n"
        "print(numba.threading_layer(), 'done')\n"
    )
    assert python(program, NUMBA_THREADING_LAYER="workqueue") == ["workqueue done"]


@pytest.mark.parametrize("at_a_time", [1, 2])
def test_images_are_computed_two_at_a_time_where_loops_can_share_the_threads(
    two_threads, monkeypatch, at_a_time
):
    numba = pytest.importorskip("numba")
    scene, four = random_scene(20), CAMERAS.select(torch.tensor([0, 0, 0, 0]))
    singly = [render(scene, camera, backend="numba").rgb for camera in four.singles()]
    amounts = contributions(scene, CAMERAS, backend="numba")
    if at_a_time > 1 and numba.threading_layer() == "workqueue":
        pytest.skip("numba finds neither OpenMP nor TBB, and its own threads take one loop at once")
    backend = import_module("cvtgs.rendering.numba_backend")
    settings, callers = backend._settings, []
    meet = threading.Barrier(at_a_time, timeout=30)

    def met(*arguments):
        meet.wait()  # passes only if so many images are computed at the same time
        callers.append(threading.get_ident())
        return settings(*arguments)

    monkeypatch.setattr(backend, "_settings", met)
    several = "cvtgs.rendering.compiled.takes_several_loops"
    monkeypatch.setattr(several, lambda: at_a_time > 1)
    assert torch.equal(render(scene, four, backend="numba").rgb, torch.cat(singly))
    views = observe(scene, four, backend="numba")
    assert torch.equal(views.rgb, torch.cat(singly))
    assert torch.equal(views.contributions, amounts + amounts + amounts + amounts)
    assert torch.equal(contributions(scene, four, backend="numba"), views.contributions)
    assert len(callers) == 12
    assert (threading.get_ident() in callers) == (at_a_time == 1)


def test_images_with_gradients_are_computed_one_after_the_other(monkeypatch):
    pytest.importorskip("numba")
    monkeypatch.setattr("cvtgs.rendering.numba_backend.for_each_camera", pytest.fail)
    scene = random_scene(20)
    means = scene.means.clone().requires_grad_()
    moved = scene.with_tensors({"means": means})
    both = CAMERAS.select(torch.tensor([0, 0]))
    render(moved, both, backend="numba").rgb.sum().backward()
    twice, means.grad = means.grad, None
    render(moved, CAMERAS, backend="numba").rgb.sum().backward()
    assert torch.allclose(twice, 2 * means.grad)
    assert float(twice.abs().max()) > 0


def test_numba_is_installed_with_the_package_where_it_has_wheels():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    (found,) = [Requirement(n) for n in project["dependencies"] if n.startswith("numba")]
    assert "numba" not in project["optional-dependencies"]
    here = {"platform_python_implementation": "CPython", "python_version": "3.13"}
    for machine in ("x86_64", "AMD64", "aarch64", "arm64", "ARM64"):
        assert found.marker.evaluate({**here, "platform_machine": machine})
        assert not found.marker.evaluate(
            {**here, "platform_machine": machine, "python_version": "3.16"}
        )
    assert not found.marker.evaluate({**here, "platform_machine": "ppc64le"})


@pytest.mark.long
def test_importing_loads_no_optional_package():
    lines = python(
        "import sys\n"
        "import cvtgs.rendering\n"
        "print(sorted({'numba', 'llvmlite', 'gsplat', 'scipy'} & set(sys.modules)))\n"
        "cvtgs.rendering.choose_backend('torch', __import__('torch').device('cpu'))\n"
        "print(sorted({'numba', 'llvmlite', 'gsplat', 'scipy'} & set(sys.modules)))\n"
    )
    assert lines == ["[]", "[]"]


@pytest.mark.parametrize("backend", ["torch", *(["numba"] if find_spec("numba") else [])])
def test_progress_and_interruption(backend):
    events = []
    both = CAMERAS.select(torch.tensor([0, 0]))
    render(random_scene(3), both, backend=backend, listener=events.append)
    assert events == [ProgressEvent(stage="render", done=done, total=2) for done in range(3)]

    def stop(event):
        if event.done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render(random_scene(3), both, backend=backend, listener=stop)


@pytest.mark.parametrize("backend", ["torch", *(["numba"] if find_spec("numba") else [])])
def test_cameras_of_another_dtype(backend):
    scene = random_scene(20)
    doubled = Cameras(viewmats=CAMERAS.viewmats.double(), Ks=CAMERAS.Ks.double(), width=8, height=6)
    found, wanted = (render(scene, c, backend=backend).rgb for c in (doubled, CAMERAS))
    assert torch.equal(found, wanted)
    assert math.isfinite(found.sum())
