"""The page of ``cvtgs view`` and the standalone page, with viser, in headless Chromium.

``nox -s viewers`` runs this. The browser can resolve no host but this one, so the page loads
nothing from elsewhere.
"""

import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import cvtgs
from browser_cases import BROWSER, SOFTWARE_WEBGL, needs_browser
from cvtgs.viewer import SceneViewer, ViewerServer, camera_of, scene_page

SECONDS = 120.0
WIDTH, HEIGHT = 1000, 700
PICTURE = 300
MOST = 1.5
"""Largest mean difference from our image, of 255 levels; we measured 0.5, and 3 at another size."""

pytestmark = [needs_browser, pytest.mark.long, pytest.mark.filterwarnings("ignore")]
pytest.importorskip("viser", reason="needs the extra cvtgs[view]")


@pytest.fixture(scope="module")
def scene() -> cvtgs.GaussianScene:
    return cvtgs.synthetic.scene("object", 12_000, sh_degree=0, seed=3)


@contextmanager
def browser(folder: Path, address: str, *words: str) -> Iterator[subprocess.Popen[bytes]]:
    command = [str(BROWSER), *SOFTWARE_WEBGL, f"--user-data-dir={folder / 'profile'}"]
    command += ["--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1", *words, address]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            yield process
        finally:
            process.terminate()


def until(condition: Callable[[], bool], what: str) -> None:
    end = time.monotonic() + SECONDS
    while not condition():
        assert time.monotonic() < end, what
        time.sleep(0.5)


def difference(small: cvtgs.GaussianScene, client: Any) -> float:
    """Return the mean difference between the page's image of a scene and ours."""
    camera, width = client.camera, round(PICTURE * client.camera.aspect)
    cameras = camera_of(
        tuple(camera.wxyz), tuple(camera.position), fov=camera.fov, aspect=width / PICTURE
    )
    image = cvtgs.render(small, cameras.resized(width, PICTURE), background=torch.ones(3))
    wanted = image.rgb[0].clamp(0, 1).mul(255).numpy()
    return float(np.abs(client.get_render(PICTURE, width) - wanted).mean())


def test_moving_the_slider_changes_the_picture(tmp_path: Path, scene: cvtgs.GaussianScene) -> None:
    server = ViewerServer(SceneViewer(scene, {}, device="cpu"), preset="draft", rho=0.1)
    clients, simplifier = server._server.get_clients, cvtgs.Simplifier(preset="draft", device="cpu")
    first, second = (simplifier.simplify(scene, 10**power) for power in (-1.0, -2.5))
    try:
        server.finish()
        with browser(tmp_path, server.address, f"--window-size={WIDTH},{HEIGHT}"):
            until(lambda: len(clients()) == 1, "no browser came")
            (client,) = clients().values()
            until(lambda: difference(first, client) < MOST, "the first picture is another one")
            assert difference(second, client) > MOST
            server._slider.value = -2.5
            until(lambda: difference(second, client) < MOST, "the picture did not change")
            assert difference(first, client) > MOST
    finally:
        server.close()


def test_the_standalone_page_shows_a_scene(tmp_path: Path, scene: cvtgs.GaussianScene) -> None:
    """It looks the same as a file and from a server: Chromium starts some workers only for these.

    Without its worker, the page blends Gaussians in the order of the rows.
    """
    backwards = scene.select(torch.arange(len(scene) - 1, -1, -1))
    page = tmp_path / "page.html"
    page.write_text(scene_page({"full": scene, "backwards": backwards}), encoding="utf-8")
    with served(tmp_path) as address:
        from_server = pictured(tmp_path / "served", f"{address}/{page.name}")
    as_file = pictured(tmp_path / "file", page.as_uri())
    colored = np.ptp(as_file, axis=2) > 30
    assert 0.01 < float(colored.mean()) < 0.9
    assert float(np.abs(as_file - from_server).mean()) < MOST


def pictured(folder: Path, address: str) -> np.ndarray:
    """Return the right half of a page, without viser's message about WebGL and the time line."""
    folder.mkdir()
    picture = folder / "picture.png"
    words = (
        "--virtual-time-budget=20000",
        f"--screenshot={picture}",
        f"--window-size={WIDTH},{HEIGHT}",
    )
    with browser(folder, address, *words):
        until(picture.is_file, "no picture was taken")
    with Image.open(picture) as image:
        pixels = np.asarray(image.convert("RGB"), dtype=np.float32)
    return pixels[:-60, WIDTH // 2 :]


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve a folder; yield the address."""
    handler = partial(SimpleHTTPRequestHandler, directory=folder)
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
