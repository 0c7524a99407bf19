"""Show files in third-party viewers, whose pages are in ``tests/data/viewers``.

``nox -s viewers`` installs the viewers from npm. A test page shows a file in headless Chromium with
software WebGL and sends pictures until one matches the picture of our renderer.
"""

import base64
import io
import math
import os
import subprocess
import threading
import time
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlencode

import numpy as np
import pytest
import torch
from PIL import Image

import cvtgs
from browser_cases import BROWSER, SOFTWARE_WEBGL
from cvtgs.cameras import look_at

MODULES = Path(os.environ.get("CVTGS_NODE_MODULES", "none"))
PAGES = Path(__file__).parent / "data" / "viewers"
PACKAGES = {
    "cesium": ("cesium",),
    "gaussiansplats3d": ("@mkkellogg/gaussian-splats-3d", "three"),
    "playcanvas": ("playcanvas",),
    "spark": ("@sparkjsdev/spark", "three"),
    "three": ("three",),
}
"""What each page loads from npm."""

WIDTH, HEIGHT, FIELD_OF_VIEW = 640, 480, 50.0
EYE, TARGET = (1.5, -1.2, -3.6), (0.0, 0.0, 0.0)
SECONDS = 120.0
MOST = 2.0
"""Largest mean difference from our picture, in levels of 255: viewers cut Gaussians off at other
radii, and sort and blend them with fewer bits."""


class Pictured(NamedTuple):
    """A scene and its picture by our renderer."""

    scene: cvtgs.GaussianScene
    picture: np.ndarray


class Served:
    """A server for a folder, the pages and the modules; it stores the data that the pages send."""

    def __init__(self, folder: Path) -> None:
        self.pictures: list[np.ndarray] = []
        self.said: list[str] = []
        self.folder = folder
        served = self

        class Handler(SimpleHTTPRequestHandler):
            def translate_path(self, path: str) -> str:
                first, _, rest = path.split("?", maxsplit=1)[0].lstrip("/").partition("/")
                roots = {"modules": MODULES, "pages": PAGES, "files": folder}
                return str(roots.get(first, folder / "none") / rest)

            def do_POST(self) -> None:
                content = self.rfile.read(int(self.headers["Content-Length"])).decode()
                if self.path == "/picture":
                    data = base64.b64decode(content.partition(",")[2])
                    with Image.open(io.BytesIO(data)) as image:
                        served.pictures.append(np.asarray(image.convert("RGB"), dtype=np.float32))
                else:
                    served.said.append(content)
                self.send_response(204)
                self.end_headers()

            def log_message(self, *_: Any) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.address = f"http://127.0.0.1:{self._server.server_port}"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()


def case(page: str, *values: Any) -> Any:
    """Return the parameters of a test, which is skipped without the packages of the page."""
    missing = [name for name in PACKAGES[page] if not (MODULES / name).is_dir()]
    reason = f"needs {', '.join(missing)} in the folder that CVTGS_NODE_MODULES names"
    return pytest.param(page, *values, marks=pytest.mark.skipif(bool(missing), reason=reason))


def pictured_scene() -> Pictured:
    """Return a scene whose three channels differ in colours and in view-dependent light."""
    scene = cvtgs.synthetic.scene("object", 12_000, sh_degree=1, seed=3)
    sh0 = scene.sh0 + torch.tensor([0.5, 0.0, -0.8])
    scene = scene.with_tensors({"sh0": sh0, "shN": scene.shN * torch.tensor([1.0, 0.7, 0.3])})
    return Pictured(scene, picture_of(scene))


def picture_of(scene: cvtgs.GaussianScene) -> np.ndarray:
    focal = 0.5 * HEIGHT / math.tan(math.radians(0.5 * FIELD_OF_VIEW))
    view = look_at(torch.tensor([EYE]), torch.tensor([TARGET]), torch.tensor([0.0, -1.0, 0.0]))
    matrix = torch.tensor([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1.0]])
    cameras = cvtgs.Cameras(viewmats=view, Ks=matrix[None], width=WIDTH, height=HEIGHT)
    return cvtgs.render(scene, cameras).rgb[0].clamp(0, 1).mul(255).numpy()


def difference(first: np.ndarray, second: np.ndarray) -> float:
    return float(np.abs(first - second).mean())


def least_difference(
    served: Served, wanted: np.ndarray, page: str, *, most: float = MOST, **query: str
) -> float:
    """Show a page until its picture matches ours; return the least mean difference seen."""
    camera = ",".join(map(str, (*EYE, *TARGET)))
    words = urlencode({"camera": camera, "fov": FIELD_OF_VIEW} | query)
    address = f"{served.address}/pages/{page}.html?{words}"
    command = [str(BROWSER), *SOFTWARE_WEBGL, f"--user-data-dir={served.folder / 'profile'}"]
    command += [f"--window-size={WIDTH},{HEIGHT}", address]
    least, end = math.inf, time.monotonic() + SECONDS
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as browser:
        try:
            while least > most and time.monotonic() < end and not served.said:
                time.sleep(0.5)
                for picture in served.pictures[-1:]:
                    assert picture.shape == wanted.shape
                    least = min(least, difference(picture, wanted))
        finally:
            browser.terminate()
    assert not served.said
    assert served.pictures
    return least
