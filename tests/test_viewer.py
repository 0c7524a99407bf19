"""The page of ``cvtgs view`` without a browser, on a stand-in for viser."""

import math
import re
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

import viser_stand_in
from cvtgs import GaussianScene, Simplifier, load, save
from cvtgs.cli.main import main
from cvtgs.errors import ConfigError, DeviceError, InvalidArgumentError
from cvtgs.viewer import SceneViewer, ShownScene, ViewerServer, camera_of
from cvtgs.viewer.scenes import FULL
from cvtgs.viewer.server import SceneNode
from scenes import random_scene, same_bits

FACTS, NOTES = "markdown 0", "markdown 7"

pytestmark = pytest.mark.usefixtures("without_viser")


@pytest.fixture
def scene() -> GaussianScene:
    return random_scene(500, degree=1, size=0.05)


@pytest.fixture
def page(scene: GaussianScene) -> Iterator[Any]:
    """Yield a page that shows its first result, with one additional scene."""
    other = random_scene(7, degree=0)
    viewer = SceneViewer(scene, {"other.ply": other}, device="cpu")
    server = ViewerServer(viewer, preset="draft", rho=0.1)
    server.finish()
    yield SimpleNamespace(server=server, viewer=viewer, stand=viser_stand_in.ViserServer.latest)
    server.close()
    assert not viser_stand_in.ViserServer.latest.is_open


def control(page: Any, label: str) -> Any:
    return page.stand.gui.controls[label]


def notes(page: Any) -> str:
    """Return the text of the notes, in which punctuation is escaped, as the page shows it."""
    content: str = control(page, NOTES).content
    return re.sub(r"\\([!-/:-@\[-`{-~])", r"\1", content)


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < end, "nothing came"
        time.sleep(0.01)


def visible(page: Any) -> list[int]:
    return [node.count for node in page.stand.scene.nodes.values() if node.visible]


@pytest.mark.slow
def test_the_page_starts_with_the_simplified_scene(page: Any) -> None:
    assert page.server.address == "http://127.0.0.1:8080"
    assert page.stand.scene.up == "-y"
    assert visible(page) == [50]
    assert control(page, FACTS).content.startswith("50 of 500 Gaussians, about 5.2 kB as .ply, ")
    assert control(page, "show").options == ("simplified", "full scene", "other.ply")


def test_an_ipv6_host_is_in_brackets(page: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page.stand, "host", "::1")
    assert page.server.address == "http://[::1]:8080"


@pytest.mark.slow
def test_moving_the_slider_shows_the_simplified_scene(page: Any, scene: GaussianScene) -> None:
    control(page, "ratio (log10)").value = -2.0
    until(lambda: visible(page) == [5])
    until(lambda: control(page, FACTS).content.startswith("5 of 500 Gaussians"))
    wanted = Simplifier(preset="draft", device="cpu").simplify(scene, 0.01)
    assert same_bits(page.viewer.scenes["simplified"].scene, wanted)


def test_the_ratio_to_start_with_is_exact(monkeypatch: pytest.MonkeyPatch) -> None:
    """Until the slider, whose steps are larger, is moved."""
    seen: list[float] = []

    def simplify(viewer: SceneViewer, _: str, rho: float) -> ShownScene:
        seen.append(rho)
        return viewer.scenes["full scene"]

    monkeypatch.setattr(SceneViewer, "simplify", simplify)
    server = ViewerServer(SceneViewer(random_scene(3)), rho=0.00011)
    server.finish()
    slider = viser_stand_in.ViserServer.latest.gui.controls["ratio (log10)"]
    assert slider.value == pytest.approx(-3.95)
    slider.value = -2.0
    until(lambda: len(seen) == 2)
    server.close()
    assert seen == [0.00011, 0.01]


@pytest.mark.slow
def test_data_shared_by_all_sizes_is_computed_in_advance(
    scene: GaussianScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    warm: list[str] = []
    monkeypatch.setattr(SceneViewer, "warm_up", lambda _, preset: warm.append(preset))
    viewer = SceneViewer(scene, device="cpu")
    server = ViewerServer(viewer, preset="draft", rho=0.1)
    until(lambda: warm == ["draft"])
    server.close()


@pytest.mark.slow
def test_presets_and_scenes_can_be_switched(page: Any) -> None:
    control(page, "preset").value = "fast"
    until(lambda: control(page, FACTS).content.endswith("with fast"))
    control(page, "show").value = "full scene"
    assert visible(page) == [500]
    assert control(page, FACTS).content == "500 of 500 Gaussians, about 52.0 kB as .ply"
    control(page, "show").value = "other.ply"
    assert visible(page) == [7]


@pytest.mark.slow
def test_too_little_memory_is_an_error_on_the_page(
    page: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> ShownScene:
        raise MemoryError

    with monkeypatch.context() as patch:
        patch.setattr(SceneViewer, "simplify", fail)
        control(page, "ratio (log10)").value = -1.5
        until(lambda: "this needs more memory than is available" in notes(page))
    control(page, "ratio (log10)").value = -2.0
    until(lambda: control(page, FACTS).content.startswith("5 of 500 Gaussians"))


def score_view(page: Any, **odd: Any) -> None:
    """Ask for the PSNR of a view, as a visitor of the page does."""
    seen = {"wxyz": (1, 0, 0, 0), "position": (0, 0, -4), "fov": 0.8}
    camera = SimpleNamespace(**seen | {"image_width": 150, "image_height": 100} | odd)
    control(page, "PSNR of this view").call(SimpleNamespace(camera=camera))


@pytest.mark.slow
def test_the_current_view_is_scored(page: Any) -> None:
    score_view(page)
    assert notes(page).startswith("simplified: ")
    view = camera_of((1, 0, 0, 0), (0, 0, -4), fov=0.8, aspect=1.5)
    assert f"{page.viewer.score('simplified', view):.2f} dB" in notes(page)
    assert page.viewer.score("full scene", view) > 60
    score_view(page, position=(0, 0, 1e9))
    assert notes(page) == "**this view shows nothing of the full scene.**"


@pytest.mark.slow
def test_the_shown_scene_is_saved(
    page: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    control(page, "file").value = "out.ply"
    for said in ("out.ply: 50 Gaussians.", "**out.ply exists already; give another name.**"):
        control(page, "Save this scene").call()
        assert said in notes(page)
    assert same_bits(load("out.ply"), page.viewer.scenes["simplified"].scene)
    control(page, "file").value = "  "
    control(page, "Save this scene").call()
    assert notes(page) == "**a file name is needed to save a scene, found none.**"


@pytest.mark.slow
def test_markup_in_names_is_not_interpreted(
    page: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = "*a* <iframe srcdoc='<img src=x onerror=f()>'> `b`.ply"
    control(page, "file").value = path
    control(page, "Save this scene").call()
    assert notes(page) == f"{path}: 50 Gaussians."
    assert not re.search(r"(?<!\\)[<>*`_]", control(page, NOTES).content)


@pytest.mark.slow
def test_the_standalone_page_shows_every_scene(page: Any) -> None:
    assert page.server.page() == "<html>[[500], [50], [7]] True</html>"
    assert visible(page) == [50]


@pytest.mark.slow
def test_compare_and_levels_write_a_page(
    tmp_path: Path, scene: GaussianScene, capsys: pytest.CaptureFixture[str]
) -> None:
    full, small = tmp_path / "a.ply", tmp_path / "b.ply"
    save(scene, full)
    save(scene.select(torch.arange(40)), small)
    views = ["--views", "1", "--size", "32", "--device", "cpu", "--viewer"]
    folder = tmp_path / "compared"
    assert main(["compare", str(full), str(small), "-o", str(folder), *views]) == 0
    assert (folder / "viewer.html").read_text() == "<html>[[500], [40]] True</html>"
    assert "viewer.html: 2 scenes in 3D" in capsys.readouterr().out
    assert '<a href="viewer.html">' in (folder / "index.html").read_text()
    assert main(["compare", str(full), str(small), "-o", f"{folder}2", *views[:-1]]) == 0
    assert "viewer.html" not in (tmp_path / "compared2" / "index.html").read_text()
    folder = tmp_path / "levels"
    words = ["levels", str(full), "-o", str(folder), "--rho", "0.1,0.02", "--no-scores", *views[4:]]
    assert main([*words, "--preset", "draft"]) == 0
    assert (folder / "viewer.html").read_text() == "<html>[[500], [50], [10]] True</html>"
    assert main([*words, "--stream", "sog"]) == 1
    assert "--viewer cannot be used with --stream" in capsys.readouterr().err


def test_the_camera_of_a_view_equals_that_by_hand() -> None:
    """A half turn about y looks back along z; a point in front projects to the centre."""
    cameras = camera_of((0, 0, 1, 0), (1, 2, 3), fov=math.pi / 2, aspect=2.0)
    assert (cameras.width, cameras.height) == (480, 240)
    point = cameras.viewmats[0].double() @ torch.tensor([1, 2, -1, 1], dtype=torch.float64)
    torch.testing.assert_close(point, torch.tensor([0, 0, 4, 1], dtype=torch.float64))
    wanted = [[120.0, 0, 240], [0, 120, 120], [0, 0, 1]]
    torch.testing.assert_close(cameras.Ks[0], torch.tensor(wanted, dtype=torch.float64))


@pytest.mark.parametrize(
    ("aspect", "size"),
    [(1.0, (480, 480)), (0.5, (240, 480)), (1e-9, (16, 480)), (1e9, (480, 16))],
)
def test_images_of_a_view_are_small_whatever_the_window(
    aspect: float, size: tuple[int, int]
) -> None:
    cameras = camera_of((1, 0, 0, 0), (0, 0, 0), fov=1.0, aspect=aspect)
    assert (cameras.width, cameras.height) == size


@pytest.mark.slow
@pytest.mark.parametrize(
    "odd",
    [
        {"image_width": 0},
        {"image_height": 0},
        {"image_width": math.nan},
        {"image_width": math.inf},
        {"fov": 0.0},
        {"fov": math.pi},
        {"wxyz": (0, 0, 0, 0)},
        {"position": (math.inf, 0, 0)},
    ],
)
def test_a_view_that_shows_nothing_is_an_error_on_the_page(page: Any, odd: dict[str, Any]) -> None:
    score_view(page, **odd)
    assert notes(page).startswith("**a view must have a size, a direction and a field of view")
    assert "np." not in notes(page)


def test_a_scene_that_is_not_there_yet_is_an_error(scene: GaussianScene, tmp_path: Path) -> None:
    viewer = SceneViewer(scene, device="cpu")
    view = camera_of((1, 0, 0, 0), (0, 0, -4), fov=0.8, aspect=1.5)
    with pytest.raises(InvalidArgumentError, match="the scene 'simplified' does not exist, or not"):
        viewer.score("simplified", view)
    with pytest.raises(InvalidArgumentError, match="the scene 'simplified' does not exist, or not"):
        viewer.save("simplified", tmp_path / "a.ply")


def test_names_reserved_by_the_viewer_are_refused(scene: GaussianScene) -> None:
    with pytest.raises(InvalidArgumentError, match="must not be named 'simplified'; rename it"):
        SceneViewer(scene, {"simplified": scene})


def test_scenes_can_be_switched_while_one_is_drawn(
    scene: GaussianScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    draw, counts = SceneNode.draw, list[int]()

    def switch_and_draw(node: SceneNode, drawn: GaussianScene, *, visible: bool) -> None:
        control(SimpleNamespace(stand=viser_stand_in.ViserServer.latest), "show").value = FULL
        draw(node, drawn, visible=visible)
        counts.append(len(drawn))

    monkeypatch.setattr(SceneNode, "draw", switch_and_draw)
    server = ViewerServer(SceneViewer(scene, device="cpu"), rho=0.01)
    server.finish()
    server.close()
    assert counts == [500, 5]


@pytest.mark.slow
def test_the_command_writes_a_page(
    tmp_path: Path, scene: GaussianScene, capsys: pytest.CaptureFixture[str]
) -> None:
    save(scene, tmp_path / "a.ply")
    save(random_scene(7), tmp_path / "b.ply")
    names = [str(tmp_path / name) for name in ("a.ply", "b.ply", "b.ply")]
    words = ["view", *names, "--page", str(tmp_path / "a.html"), "--rho", "3%"]
    assert main([*words, "--preset", "draft", "--device", "cpu"]) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'a.html'}: 3 scenes; open it in a browser.\n"
    assert (tmp_path / "a.html").read_text() == "<html>[[500], [15], [7]] True</html>"
    assert main(words) == 1
    assert "a.html: the output must not exist yet" in capsys.readouterr().err


def test_options_of_a_server_are_refused_for_a_standalone_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["view", str(tmp_path / "a.ply"), "--page", str(tmp_path / "a.html")]
    for more in (["--port", "99"], ["--host", "localhost"], ["--no-browser"]):
        assert main([*words, *more]) == 1
        assert "are for serving the page, and cannot be used with --page" in capsys.readouterr().err


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
def test_names_that_are_not_utf8_are_escaped(tmp_path: Path, scene: GaussianScene) -> None:
    one, other = tmp_path / "a.ply", tmp_path / "b\udcff.ply"
    save(scene, one)
    save(random_scene(7), other)
    assert main(["view", str(one), str(other), "--page", str(tmp_path / "a.html"), "--quiet"]) == 0
    stand = viser_stand_in.ViserServer.latest
    for text in (*stand.scene.labels.values(), *stand.gui.controls["show"].options):
        text.encode()
    assert r"b\udcff.ply" in stand.gui.controls["show"].options[-1]


def test_a_page_does_not_replace_a_scene(
    tmp_path: Path, scene: GaussianScene, capsys: pytest.CaptureFixture[str]
) -> None:
    one, other = tmp_path / "a.ply", tmp_path / "b.ply"
    save(scene, one)
    save(scene, other)
    for path in (one, other):
        (page := path.with_suffix(".html")).symlink_to(path)
        assert main(["view", str(one), str(other), "--page", str(page), "--overwrite"]) == 1
        assert "--page and the scenes must be different files, found" in capsys.readouterr().err
    assert len(load(one)) == len(load(other)) == len(scene)


def test_a_page_without_the_simplified_scene_is_an_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> None:
        raise DeviceError("there is no such device.")

    monkeypatch.setattr(SceneViewer, "simplify", fail)
    save(random_scene(3), tmp_path / "a.ply")
    assert main(["view", str(tmp_path / "a.ply"), "--page", str(tmp_path / "a.html")]) == 1
    assert capsys.readouterr().err == "cvtgs: error: there is no such device.\n"
    assert not (tmp_path / "a.html").exists()
    assert not viser_stand_in.ViserServer.latest.is_open


def test_an_interrupt_is_the_usual_end(tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.setattr(ViewerServer, "wait", lambda _: signal.raise_signal(signal.SIGINT))
    save(random_scene(3), tmp_path / "a.ply")
    assert main(["view", str(tmp_path / "a.ply"), "--no-browser", "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")
    assert not viser_stand_in.ViserServer.latest.is_open


def test_wrong_values_are_refused_before_a_server_starts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(viser_stand_in, "ViserServer", None)
    viewer = SceneViewer(random_scene(3))
    with pytest.raises(ConfigError, match="preset must be one of draft, "):
        ViewerServer(viewer, preset="nope")
    with pytest.raises(InvalidArgumentError, match="rho must be"):
        ViewerServer(viewer, rho=0.0)
    with pytest.raises(
        InvalidArgumentError, match=r"of this machine, found '192\.0\.2\.1': cannot"
    ):
        ViewerServer(viewer, host="192.0.2.1")
    assert main(["view", str(tmp_path / "missing.ply"), "--preset", "nope"]) == 1
    assert "found 'nope'" in capsys.readouterr().err
