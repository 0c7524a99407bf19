"""Scenes on a viser server, and standalone pages that show them.

No other file imports viser.
"""

import io
import math
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from typing import TYPE_CHECKING, Any

import torch

from cvtgs.errors import MissingDependencyError, how_to_install
from cvtgs.math.frames import robust_frame
from cvtgs.math.parameters import build_covariances, normalize_quats
from cvtgs.math.spherical_harmonics import SH_C0
from cvtgs.scene import GaussianScene
from cvtgs.validity import valid_part
from cvtgs.views import automatic_views
from cvtgs.views.layout import find_layout

if TYPE_CHECKING:
    import viser

__all__ = ["check_viewer", "scene_page"]

Point = tuple[float, float, float]

_FLIP_SECONDS = 2.0
"""Seconds for which a standalone page shows each scene."""

_ANY_PORT = 8999
"""First port tried for the temporary server that records a standalone page."""

_ABOVE = 0.85
"""Height of labels in the initial view, as a share of half the image; all scenes share it."""


def scene_page(scenes: Mapping[str, GaussianScene]) -> str:
    """Return a standalone page with a 3D viewer, whose time line flips between scenes.

    Colours are those of the constant SH band.

    Args:
        scenes: The scenes by name; the camera starts at a good view of the first.

    Returns:
        HTML that needs no server and fetches nothing.

    Raises:
        MissingDependencyError: viser is not installed.
    """
    server = start_server("127.0.0.1", _ANY_PORT)
    try:
        place = look_at(server, next(iter(scenes.values())))
        nodes = {
            name: SceneNode(server, name, f"/scene {k}", label=place)
            for k, name in enumerate(scenes)
        }
        for name, scene in scenes.items():
            nodes[name].draw(scene, visible=False)
        return record_page(server, list(nodes.values()))
    finally:
        stop_server(server)


class SceneNode:
    """A scene on a server, and a label with its name that is shown and hidden with it."""

    def __init__(self, server: "viser.ViserServer", name: str, path: str, *, label: Point) -> None:
        self._server, self._name, self._path, self._label = server, name, path, label
        self._splats: Any = None

    def draw(self, scene: GaussianScene, *, visible: bool) -> None:
        """Draw a scene in place of the current one."""
        part = valid_part(scene).to("cpu")
        covariances = build_covariances(part.scales, normalize_quats(part.quats))
        self._splats = self._server.scene.add_gaussian_splats(
            self._path,
            centers=part.means.float().numpy(),
            covariances=covariances.float().numpy(),
            rgbs=(0.5 + SH_C0 * part.sh0[:, 0]).clamp(0, 1).float().numpy(),
            opacities=part.opacities[:, None].float().numpy(),
            visible=visible,
        )
        self._server.scene.add_label(
            f"{self._path}/name", f"{self._name}: {len(part):,} Gaussians", position=self._label
        )

    def show(self, visible: bool) -> None:
        """Show or hide the scene and its label."""
        self._splats.visible = visible


def record_page(server: "viser.ViserServer", nodes: Sequence[SceneNode]) -> str:
    """Record the scenes one after the other, and return the page."""
    recorder = server.get_scene_serializer()
    for shown in nodes:
        for node in nodes:
            node.show(node is shown)
        recorder.insert_sleep(_FLIP_SECONDS)
    return str(recorder.as_html(dark_mode=True))


def look_at(server: "viser.ViserServer", scene: GaussianScene) -> Point:
    """Set up and the initial camera to a good view; return the place of labels in it."""
    scene = scene.to("cpu")
    up = find_layout(scene).up
    axis = int(up.abs().argmax())
    server.scene.set_up_direction(f"{'+' if up[axis] > 0 else '-'}{'xyz'[axis]}")
    camera = automatic_views(scene, 1)
    rotation, center = camera.viewmats[0, :3, :3], camera.centers[0]
    depth = float(rotation[2] @ (robust_frame(scene.means).center.cpu().double() - center))
    depth = max(depth, 1e-3)
    target, half = center + rotation[2] * depth, camera.height / 2 / float(camera.Ks[0, 1, 1])
    server.initial_camera.position = _three(center)
    server.initial_camera.look_at = _three(target)
    server.initial_camera.fov = 2 * math.atan(half)
    return _three(target - rotation[1] * (_ABOVE * half * depth))


def _three(point: torch.Tensor) -> Point:
    x, y, z = point.tolist()
    return x, y, z


def start_server(host: str, port: int) -> "viser.ViserServer":
    module = _viser()
    with redirect_stdout(io.StringIO()):  # viser prints even if verbose is False
        server: viser.ViserServer = module.ViserServer(
            host=host, port=port, label="cvtgs", verbose=False
        )
    return server


def stop_server(server: "viser.ViserServer") -> None:
    with redirect_stdout(io.StringIO()):
        server.stop()


def check_viewer() -> None:
    """Check that pages can be served, before scenes are read.

    Raises:
        MissingDependencyError: viser is not installed.
    """
    _viser()


def _viser() -> Any:
    try:
        import viser  # noqa: PLC0415 (optional)
    except ImportError as error:
        raise MissingDependencyError(
            f"the viewer needs the package viser; {how_to_install('cvtgs[view]')}."
        ) from error
    return viser
