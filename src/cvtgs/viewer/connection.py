"""Start and stop a viser server, to which only its own page may connect."""

import io
import os
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext, redirect_stdout
from http import HTTPStatus
from importlib import import_module
from inspect import isawaitable
from ipaddress import ip_address
from threading import Lock
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from cvtgs.errors import InvalidArgumentError, MissingDependencyError, how_to_install, reason_of

if TYPE_CHECKING:
    import viser

_STARTING = Lock()  # held while the server of websockets is replaced

_MOST_PORTS, _LAST_PORT = 1000, 65535  # number of ports to try, as viser does

_OWN_NAMES = {"localhost", "127.0.0.1", "::1"}


def check_viewer() -> None:
    """Check that pages can be served, before scenes are read.

    Raises:
        MissingDependencyError: viser is not installed.
    """
    try:
        import viser  # noqa: F401, PLC0415 (optional)
    except ImportError as error:
        raise MissingDependencyError(
            f"the viewer needs the package viser; {how_to_install('cvtgs[view]')}."
        ) from error


def start_server(host: str, port: int) -> "viser.ViserServer":
    """Start a server; on an address of this machine alone, it refuses pages of other sites."""
    check_viewer()
    import viser  # noqa: PLC0415 (optional)

    address, port = _open_address(host, port)  # viser would wait for ever if it cannot listen
    is_own_machine = ip_address(address.partition("%")[0]).is_loopback
    names = {*_OWN_NAMES, host.lower(), address}
    guard = _refusing_other_sites(names) if is_own_machine else nullcontext()
    with redirect_stdout(io.StringIO()), guard:  # viser prints even if verbose is False
        return viser.ViserServer(host=host, port=port, label="cvtgs", verbose=False)


def stop_server(server: "viser.ViserServer") -> None:
    """Stop a server."""
    with redirect_stdout(io.StringIO()):
        server.stop()


def _open_address(host: str, port: int) -> tuple[str, int]:
    """Return the address of a host, and the first free port; raise if there is none."""
    try:
        family, kind, *_, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as probe:
            probe.bind(address)
    except (OSError, UnicodeError) as error:
        raise InvalidArgumentError(
            f"host must be an address or a name of this machine, found {host!r}: "
            f"{reason_of(error)}."
        ) from error
    last = min(port + _MOST_PORTS, _LAST_PORT)
    for number in range(port, last + 1):
        with socket.socket(family, kind) as probe:
            if os.name == "posix":  # ports of connections that have just ended are free
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((address[0], number, *address[2:]))
            except PermissionError as error:
                raise InvalidArgumentError(
                    f"port must be one that this user may open, found {port}: {reason_of(error)}."
                ) from error
            except OSError:
                continue
            return str(address[0]), number
    raise InvalidArgumentError(f"a port from {port} to {last} must be free, found none.")


@contextmanager
def _refusing_other_sites(names: set[str]) -> Iterator[None]:
    """Make servers that start meanwhile refuse pages that have none of these host names."""
    # A browser lets any page connect to this machine, and a page's name may resolve to it. viser
    # checks neither, and takes no such check, so it gets it from the library that it serves with.
    library: Any = import_module("websockets.asyncio.server")
    serve = library.serve

    def checking(*args: Any, process_request: Any, **more: Any) -> Any:
        async def respond(connection: Any, request: Any) -> Any:
            if not is_own(request.headers, names):
                text = (
                    "Only the page at the address that cvtgs printed may connect; with --host "
                    "0.0.0.0, any page may.\n"
                )
                return connection.respond(HTTPStatus.FORBIDDEN, text)
            found = process_request(connection, request)
            return await found if isawaitable(found) else found

        return serve(*args, process_request=respond, **more)

    with _STARTING:
        library.serve = checking
        try:
            yield
        finally:
            library.serve = serve


def is_own(headers: Mapping[str, str], names: set[str]) -> bool:
    """Return whether a request is for one of these host names; a browser's page must have one."""
    try:
        hosts = [urlsplit(f"//{headers['Host']}").hostname]
        if "Origin" in headers:
            hosts.append(urlsplit(headers["Origin"]).hostname)
    except (LookupError, ValueError):  # no or several hosts, or none that can be parsed
        return False
    return all(host in names for host in hosts)
