"""The choice of a backend, absent packages, and what importing the renderer loads."""

import math
import os
import subprocess
import sys
from importlib.util import find_spec
from types import SimpleNamespace

import pytest
import torch

from cvtgs.cameras import Cameras
from cvtgs.errors import DeviceError, InvalidArgumentError, MissingDependencyError
from cvtgs.progress import ProgressEvent
from cvtgs.rendering import choose_backend, gsplat_backend, render
from scenes import random_scene

CAMERAS = Cameras(
    viewmats=torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]])[None],
    Ks=torch.tensor([[[8.0, 0, 4], [0, 8, 3], [0, 0, 1]]]),
    width=8,
    height=6,
)


def python(program):
    """Run a program in a fresh interpreter; return the lines that it prints."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    result = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=True,
        env=environment,
    )
    return result.stdout.splitlines()


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


def test_unknown_backend():
    with pytest.raises(InvalidArgumentError) as caught:
        choose_backend("cuda", torch.device("cpu"))
    assert str(caught.value) == "backend must be one of auto, torch, numba, gsplat, found 'cuda'."


def test_without_numba():
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
        "install it with: pip install 'cvtgs[numba]', or use backend='torch'.",
    ]


def test_importing_loads_no_optional_package():
    lines = python(
        "import sys\n"
        "import cvtgs.rendering\n"
        "print(sorted({'numba', 'llvmlite', 'gsplat', 'scipy'} & set(sys.modules)))\n"
        "cvtgs.rendering.choose_backend('torch', __import__('torch').device('cpu'))\n"
        "print(sorted({'numba', 'llvmlite', 'gsplat', 'scipy'} & set(sys.modules)))\n"
    )
    assert lines == ["[]", "[]"]


@pytest.fixture
def fresh_probe():
    """Forget what the probe of gsplat found, before and after."""
    gsplat_backend._failure.cache_clear()
    yield
    gsplat_backend._failure.cache_clear()


@pytest.mark.usefixtures("fresh_probe")
def test_without_gsplat(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(MissingDependencyError) as caught:
        choose_backend("gsplat", torch.device("cuda"))
    assert str(caught.value) == (
        "backend 'gsplat' needs a working gsplat, but it cannot be imported "
        "(import of gsplat halted; None in sys.modules); "
        "install it with: pip install 'cvtgs[gsplat]', or use backend='torch'."
    )
    assert choose_backend("auto", torch.device("cuda"))[0] == "torch"


@pytest.mark.usefixtures("fresh_probe")
def test_a_gsplat_that_fails_late_is_probed_once_and_its_first_line_reported(monkeypatch):
    calls = []

    def rasterization(**_):
        calls.append(1)
        raise AttributeError("'NoneType' has no attribute 'forward'\nmany\nmore lines")

    on_cpu = torch.tensor
    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=rasterization))
    for name in ("tensor", "full", "ones", "eye"):
        plain = getattr(torch, name)
        monkeypatch.setattr(
            torch, name, lambda *a, _plain=plain, **k: _plain(*a, **(k | {"device": "cpu"}))
        )
    for _ in range(2):
        with pytest.raises(MissingDependencyError, match="failed to render") as caught:
            choose_backend("gsplat", torch.device("cuda"))
    assert len(calls) == 1
    assert on_cpu is not torch.tensor
    assert "(AttributeError: 'NoneType' has no attribute 'forward');" in str(caught.value)


@pytest.mark.parametrize("degree", [0, 2])
@pytest.mark.parametrize("comments", [(), ("SplatRenderMode: mip",)], ids=["plain", "mip"])
def test_arguments_of_gsplat(monkeypatch, degree, comments):
    """A stand-in for gsplat keeps its arguments; nothing here needs CUDA."""
    arguments = {}

    def rasterization(**options):
        arguments.update(options)
        layers = torch.arange(4.0).expand(1, 6, 8, 4)
        return layers, torch.full((1, 6, 8, 1), 0.5), {}

    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=rasterization))
    scene = random_scene(5, degree=degree, dtype=torch.float64)
    scene = type(scene)(**scene.tensors(), comments=comments)
    output = gsplat_backend.rasterize(scene, CAMERAS, sh_degree=min(1, degree))
    assert output.rgb.dtype == torch.float64
    assert output.rgb[0, 0, 0].tolist() == [0, 1, 2]
    assert output.depth[0, 0, 0] == 3
    assert output.alpha[0, 0, 0] == 0.5
    assert arguments["colors"].shape == ((5, 4, 3) if degree else (5, 3))
    assert arguments["sh_degree"] == (1 if degree else None)
    assert arguments["rasterize_mode"] == ("antialiased" if comments else "classic")
    assert (arguments["near_plane"], arguments["eps2d"], arguments["packed"]) == (0.01, 0.3, False)
    assert torch.equal(arguments["scales"], scene.scales.float())
    rotation, shift = (
        arguments["viewmats"][0, :3, :3].double(),
        arguments["viewmats"][0, :3, 3].double(),
    )
    wanted = scene.means @ CAMERAS.viewmats[0, :3, :3].double().T
    wanted = wanted + CAMERAS.viewmats[0, :3, 3].double()
    torch.testing.assert_close(
        arguments["means"].double() @ rotation.T + shift, wanted, rtol=0, atol=1e-5
    )
    assert all(t.dtype == torch.float32 for t in arguments.values() if isinstance(t, torch.Tensor))


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
