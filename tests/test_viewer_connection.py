"""Who may connect to the server of ``cvtgs view``, and what other programs can do there."""

import asyncio
import sys
import time
from http import HTTPStatus
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import viser_stand_in
from cvtgs import save
from cvtgs.cli.main import main
from cvtgs.errors import MissingDependencyError
from cvtgs.viewer import SceneViewer, ViewerServer
from cvtgs.viewer.connection import start_server
from scenes import random_scene

OWN, OTHER = (
    "own page",
    (HTTPStatus.FORBIDDEN, "Only the page at the address that cvtgs printed may"),
)


class Library:
    """The server of websockets: keeps the function that is asked about requests."""

    def __init__(self) -> None:
        self.ask: Any = None

    def serve(self, *, process_request: Any) -> None:
        self.ask = process_request


@pytest.fixture
def library(monkeypatch: pytest.MonkeyPatch) -> Library:
    """Let viser start a server of a library that stands in for websockets."""
    library = Library()

    class Server(viser_stand_in.ViserServer):
        def __init__(self, **values: Any) -> None:
            super().__init__(**values)
            library.serve(process_request=lambda connection, request: OWN)

    module = SimpleNamespace(ViserServer=Server)
    monkeypatch.setitem(sys.modules, "viser", module)
    monkeypatch.setitem(sys.modules, "websockets.asyncio.server", library)
    return library


def answer(library: Library, headers: dict[str, str]) -> Any:
    connection = SimpleNamespace(respond=lambda status, text: (status, text[: len(OTHER[1])]))
    found = library.ask(connection, SimpleNamespace(headers=headers))
    return asyncio.run(found) if asyncio.iscoroutine(found) else found


@pytest.mark.parametrize("host", ["127.0.0.1:8080", "localhost:8080", "[::1]:8080", "LOCALHOST"])
def test_the_page_of_this_machine_may_connect(library: Library, host: str) -> None:
    start_server("127.0.0.1", 8080)
    assert answer(library, {"Host": host}) == OWN
    assert answer(library, {"Host": host, "Origin": f"http://{host}"}) == OWN


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "127.0.0.1:8080", "Origin": "https://example.org"},
        {"Host": "127.0.0.1:8080", "Origin": "http://127.0.0.1.example.org"},
        {"Host": "127.0.0.1:8080", "Origin": "null"},  # a page that was opened as a file
        {"Host": "127.0.0.1:8080", "Origin": "http://["},
        {"Host": "example.org", "Origin": "http://example.org"},  # a name of another's
        {"Host": "example.org"},
        {},
    ],
)
def test_pages_of_other_sites_are_refused(library: Library, headers: dict[str, str]) -> None:
    start_server("127.0.0.1", 8080)
    assert answer(library, headers) == OTHER


def test_on_an_address_of_the_network_any_page_may_connect(library: Library) -> None:
    start_server("0.0.0.0", 8080)
    assert answer(library, {"Host": "my-machine.lan:8080"}) == OWN


@pytest.mark.parametrize("host", ["my-machine:8080", "127.0.0.2:8080", "localhost:8080"])
def test_a_named_machine_may_also_be_opened_by_its_address(
    library: Library, host: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = ("127.0.0.2", 8080)
    monkeypatch.setattr("cvtgs.viewer.connection._open_address", lambda *words: found)
    start_server("My-Machine", 8080)
    assert answer(library, {"Host": host, "Origin": f"http://{host}"}) == OWN


def test_other_servers_of_the_process_stay_as_they_are(library: Library) -> None:
    before = library.serve
    start_server("localhost", 8080)
    assert library.serve == before
    library.serve(process_request=lambda connection, request: "another server")
    assert answer(library, {"Host": "example.org"}) == "another server"


@pytest.fixture
def page(library: Library) -> Any:
    server = ViewerServer(SceneViewer(random_scene(100, degree=0), device="cpu"), rho=0.1)
    server.finish()
    yield server
    server.close()


def control(label: str) -> Any:
    return viser_stand_in.ViserServer.latest.gui.controls[label]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["/tmp/a.ply", "../a.ply", "a/../../b.ply", "C:a.ply", "a\\b.ply"])
def test_scenes_are_saved_in_the_folder_of_the_program(page: Any, name: str) -> None:
    control("file").value = name
    control("Save this scene").call()
    assert "in the folder where the program was started" in control("markdown 7").content


@pytest.mark.parametrize(
    ("value", "said"),
    [(1000.0, "100 of 100 Gaussians"), (-1000.0, "1 of 100 Gaussians"), ("text", "(TypeError)")],
)
def test_any_value_of_the_slider_leaves_the_page_working(
    page: Any, value: Any, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    control("ratio (log10)").value = value
    until(said)
    control("ratio (log10)").value = -1.0
    until("10 of 100 Gaussians")
    assert ("TypeError" in capsys.readouterr().err) == (value == "text")


def until(said: str) -> None:
    end = time.monotonic() + 30
    while said not in control("markdown 0").content + control("markdown 7").content:
        assert time.monotonic() < end, said
        time.sleep(0.01)


def test_a_missing_viser_is_an_error(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(MissingDependencyError, match=r'pip install "cvtgs\[view\]"'):
        ViewerServer(SceneViewer(random_scene(3)))
    save(random_scene(3), tmp_path / "a.ply")
    assert main(["view", str(tmp_path / "a.ply")]) == 1
    assert 'pip install "cvtgs[view]"' in capsys.readouterr().err
