"""Streams and glTF in third-party viewers: the PlayCanvas engine and CesiumJS.

``nox -s viewers`` installs both from npm and runs this in headless Chromium with software WebGL. A
test page shows a file and sends pictures until one matches the picture of our renderer.
"""

import base64
import io
import math
import os
import subprocess
import threading
import time
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlencode

import numpy as np
import pytest
import torch
from PIL import Image

import cvtgs
from browser_cases import BROWSER, SOFTWARE_WEBGL, needs_browser
from cvtgs.cameras import look_at
from cvtgs.streams import stream_file

MODULES = Path(os.environ.get("CVTGS_NODE_MODULES", "none"))
PAGES = Path(__file__).parents[1] / "data" / "viewers"
WIDTH, HEIGHT, FIELD_OF_VIEW = 640, 480, 50.0
EYE, TARGET = (1.5, -1.2, -3.6), (0.0, 0.0, 0.0)
SECONDS = 120.0
MOST = 2.0
"""Largest mean difference from our picture, in levels of 255: viewers cut Gaussians off at other
radii, and sort and blend them with fewer bits."""

pytestmark = [
    needs_browser,
    pytest.mark.long,
    pytest.mark.skipif(
        not (MODULES / "playcanvas").is_dir() or not (MODULES / "cesium").is_dir(),
        reason="needs playcanvas and cesium in the folder that CVTGS_NODE_MODULES names",
    ),
]


class Pictured(NamedTuple):
    """A scene and its picture by our renderer."""

    scene: cvtgs.GaussianScene
    picture: np.ndarray


@pytest.fixture(scope="module")
def pictured() -> Pictured:
    scene = cvtgs.synthetic.scene("object", 12_000, sh_degree=1, seed=3)
    focal = 0.5 * HEIGHT / math.tan(math.radians(0.5 * FIELD_OF_VIEW))
    view = look_at(torch.tensor([EYE]), torch.tensor([TARGET]), torch.tensor([0.0, -1.0, 0.0]))
    matrix = torch.tensor([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1.0]])
    cameras = cvtgs.Cameras(viewmats=view, Ks=matrix[None], width=WIDTH, height=HEIGHT)
    image = cvtgs.render(scene, cameras).rgb[0]
    return Pictured(scene, image.clamp(0, 1).mul(255).numpy())


class Served:
    """A server for a folder, the pages and the modules; it stores the data that the pages send."""

    def __init__(self, folder: Path) -> None:
        self.pictures: list[np.ndarray] = []
        self.said: list[str] = []
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


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    server = Served(tmp_path)
    yield server
    server.close()


def least_difference(
    served: Served, folder: Path, wanted: np.ndarray, page: str, **query: str
) -> float:
    """Show a page until its picture matches ours; return the least mean difference seen."""
    camera = ",".join(map(str, (*EYE, *TARGET)))
    words = urlencode({"camera": camera, "fov": FIELD_OF_VIEW} | query)
    address = f"{served.address}/pages/{page}?{words}"
    command = [str(BROWSER), *SOFTWARE_WEBGL, f"--user-data-dir={folder / 'profile'}"]
    command += [f"--window-size={WIDTH},{HEIGHT}", address]
    least, end = math.inf, time.monotonic() + SECONDS
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as browser:
        try:
            while least > MOST and time.monotonic() < end and not served.said:
                time.sleep(0.5)
                for picture in served.pictures[-1:]:
                    assert picture.shape == wanted.shape
                    least = min(least, float(np.abs(picture - wanted).mean()))
        finally:
            browser.terminate()
    assert not served.said
    assert served.pictures
    return least


@pytest.mark.parametrize("blocks", [1, 4])
@pytest.mark.parametrize(("kind", "page"), [("sog", "playcanvas"), ("3dtiles", "cesium")])
def test_streams_look_the_same_in_other_viewers(
    tmp_path: Path, served: Served, pictured: Pictured, kind: str, page: str, blocks: int
) -> None:
    scene, wanted = pictured
    cvtgs.save(scene, tmp_path / "scene.ply")
    report = stream_file(
        tmp_path / "scene.ply", tmp_path / "out", [1.0, 0.25, 0.05], kind=kind, blocks=blocks,
        chunk_gaussians=1024, simplifier=cvtgs.Simplifier(device="cpu"),
    )  # fmt: skip
    assert report.blocks == blocks
    index = {"sog": "lod-meta.json", "3dtiles": "tileset.json"}[kind]
    words = {"type": "gsplat"} if kind == "sog" else {}
    url = f"/files/out/{index}"
    assert least_difference(served, tmp_path, wanted, f"{page}.html", url=url, **words) < MOST


def test_gltf_looks_right_in_playcanvas(tmp_path: Path, served: Served, pictured: Pictured) -> None:
    scene, wanted = pictured
    cvtgs.save(scene, tmp_path / "scene.glb")
    words = {"type": "container", "url": "/files/scene.glb"}
    assert least_difference(served, tmp_path, wanted, "playcanvas.html", **words) < MOST


def test_a_different_picture_does_not_match(pictured: Pictured) -> None:
    wanted = pictured.picture
    assert float(np.abs(wanted[:, ::-1] - wanted).mean()) > 2 * MOST
    assert float(wanted.mean()) > 2 * MOST
