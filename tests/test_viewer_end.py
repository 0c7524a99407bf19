"""How ``cvtgs view`` ends while it simplifies, and where its page may write."""

import os
import signal
import socket
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

import viser_stand_in
from cvtgs.errors import InvalidArgumentError, RunError
from cvtgs.viewer import SceneViewer, ViewerServer
from scenes import random_scene

pytestmark = pytest.mark.usefixtures("without_viser")


@pytest.fixture
def viewer() -> SceneViewer:
    return SceneViewer(random_scene(500, degree=0, size=0.05), device="cpu")


@pytest.mark.skipif(os.name == "nt", reason="os.kill ends the process on Windows")
def test_an_interrupt_waits_for_the_simplification(
    viewer: SceneViewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process that ends while torch computes in another thread aborts."""
    begun, ended = threading.Event(), threading.Event()

    def simplify(preset: str, rho: float) -> Any:
        begun.set()
        time.sleep(1.0)
        ended.set()
        raise RunError("stopped.")

    monkeypatch.setattr(viewer, "simplify", simplify)
    server = ViewerServer(viewer)
    assert begun.wait(30)
    threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        server.wait()
    server.close()
    assert ended.is_set()


def test_closing_ends_a_simplification_at_its_next_stage(viewer: SceneViewer) -> None:
    viewer.simplify("draft", 0.1)
    viewer.stop()
    with pytest.raises(RunError, match="the viewer was stopped during "):
        viewer.simplify("draft", 0.2)
    ViewerServer(viewer).close()
    assert len(viewer.simplify("draft", 0.2).scene) == 100


def test_facts_come_back_after_an_error(
    viewer: SceneViewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = ViewerServer(viewer)
    server.finish()
    controls = viser_stand_in.ViserServer.latest.gui.controls

    def simplify(preset: str, rho: float) -> Any:
        raise RunError("no memory.")

    monkeypatch.setattr(viewer, "simplify", simplify)
    controls["ratio (log10)"].value = -1.5
    end = time.monotonic() + 30
    while "no memory" not in controls["markdown 7"].content and time.monotonic() < end:
        time.sleep(0.01)
    server.close()
    assert controls["markdown 0"].content.startswith("50 of 500 Gaussians")


@pytest.mark.skipif(os.name == "nt", reason="links need a permission on Windows")
def test_a_scene_is_not_saved_through_a_link(
    viewer: SceneViewer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    start, outside = tmp_path / "start", tmp_path / "outside"
    for folder in (start, outside):
        folder.mkdir()
    (start / "folder").symlink_to(outside)
    (start / "link.ply").symlink_to(outside / "new.ply")
    monkeypatch.chdir(start)
    server = ViewerServer(viewer)
    server.finish()
    controls = viser_stand_in.ViserServer.latest.gui.controls
    for name in ("folder/a.ply", "link.ply"):
        controls["file"].value = name
        controls["Save this scene"].call()
        assert (
            "is saved in the folder where the program was started" in controls["markdown 7"].content
        )
    controls["file"].value = "inside.ply"
    controls["Save this scene"].call()
    server.close()
    assert (start / "inside.ply").is_file()
    assert not list(outside.iterdir())


def test_a_name_that_leads_nowhere_is_a_sentence_on_the_page(viewer: SceneViewer) -> None:
    server = ViewerServer(viewer)
    server.finish()
    controls = viser_stand_in.ViserServer.latest.gui.controls
    controls["file"].value = "a\0.ply"
    controls["Save this scene"].call()
    server.close()
    assert "must be a path to write to" in controls["markdown 7"].content


def test_an_unexpected_error_ends_no_thread_if_stderr_is_closed(
    viewer: SceneViewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Closed:
        def write(self, text: str) -> None:
            raise BrokenPipeError

    def simplify(preset: str, rho: float) -> Any:
        raise TypeError("unexpected")

    monkeypatch.setattr(viewer, "simplify", simplify)
    monkeypatch.setattr(sys, "stderr", Closed())
    server = ViewerServer(viewer)
    with pytest.raises(TypeError):
        server.finish()
    assert not server._ended.is_set()
    server.close()


def test_a_server_takes_the_first_free_port_or_none(
    viewer: SceneViewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        server = ViewerServer(viewer, host="127.0.0.1", port=port)
        server.close()
        assert viser_stand_in.ViserServer.latest.port > port
        monkeypatch.setattr("cvtgs.viewer.connection._LAST_PORT", port)
        with pytest.raises(InvalidArgumentError, match=f"a port from {port} to {port} must be fr"):
            ViewerServer(viewer, host="127.0.0.1", port=port)
