"""Scenes on a page, and standalone pages of them, on a stand-in for viser."""

import math
import threading
from typing import Any

import pytest

import viser_stand_in
from cvtgs import GaussianScene
from cvtgs.viewer import scene_page
from cvtgs.viewer.server import SceneNode
from scenes import random_scene

pytestmark = pytest.mark.usefixtures("without_viser")


@pytest.fixture
def scene() -> GaussianScene:
    return random_scene(500, degree=1, size=0.05)


def test_scenes_may_require_gradients(scene: GaussianScene) -> None:
    tensors = {name: x.clone().requires_grad_() for name, x in scene.tensors().items()}
    server, node = node_of("a")
    node.draw(scene.with_tensors(tensors), visible=True)
    assert list(server.scene.nodes) == ["/scene 0"]


@pytest.mark.slow
def test_a_standalone_page_starts_in_view_of_the_scene(scene: GaussianScene) -> None:
    assert scene_page({"a": scene, "b": random_scene(7)}) == "<html>[[500], [7]] True</html>"
    stand = viser_stand_in.ViserServer.latest
    assert not stand.is_open
    assert stand.scene.up == "-y"
    assert list(stand.scene.labels.values()) == ["500 Gaussians: a", "7 Gaussians: b"]
    eye, target = stand.initial_camera.position, stand.initial_camera.look_at
    toward = [b - a for a, b in zip(eye, target, strict=True)]
    middle = scene.means.median(dim=0).values.tolist()
    assert math.dist(eye, target) == pytest.approx(math.dist(eye, middle), rel=0.3)
    assert sum(x * (m - e) for x, m, e in zip(toward, middle, eye, strict=True)) > 0
    for place in stand.scene.positions:  # labels are in the image, above its middle
        high = math.dist(place, target) / math.dist(eye, target)
        assert high == pytest.approx(0.85 * math.tan(stand.initial_camera.fov / 2), rel=1e-3)
        assert place[1] < target[1], "y points down"


def test_the_title_of_a_standalone_page_names_the_scenes(
    scene: GaussianScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    html = "<title>Viser</title><svg><title>Viser</title></svg>"
    monkeypatch.setattr(viser_stand_in.Recorder, "as_html", lambda *_, **__: html)
    page = scene_page({"<a>.ply": scene, r"b\1.ply": random_scene(7)})
    assert page.startswith(r"<title>Scenes in 3D: &lt;a&gt;.ply, b\1.ply</title><svg><title>Viser")


def node_of(name: str) -> tuple[Any, SceneNode]:
    server: Any = viser_stand_in.ViserServer("127.0.0.1", 1, label="", verbose=False)
    return server, SceneNode(server, name, "/scene 0", label=(0.0, 0.0, 0.0))


def test_a_scene_is_not_shown_or_hidden_while_another_takes_its_place(scene: GaussianScene) -> None:
    """viser raises an error if the scene that is no longer there gets a value."""
    server, node = node_of("a")
    node.draw(scene, visible=True)
    old, add = server.scene.nodes["/scene 0"], server.scene.add_gaussian_splats
    switch = threading.Thread(target=node.show, args=[False])

    def add_meanwhile(*args: Any, **values: Any) -> Any:
        new = add(*args, **values)
        switch.start()
        switch.join(timeout=0.2)
        return new

    server.scene.add_gaussian_splats = add_meanwhile
    node.draw(random_scene(7), visible=True)
    switch.join()
    assert (old.visible, server.scene.nodes["/scene 0"].visible) == (True, False)


def test_a_label_fits_on_a_phone(scene: GaussianScene) -> None:
    server, node = node_of("a folder/of many scenes/and a long name.ply")
    node.draw(scene, visible=True)
    assert server.scene.labels == {"/scene 0/name": "500 Gaussians: a folder/of many scen..."}
