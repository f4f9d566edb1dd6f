"""Start the app's server on this machine's addresses."""

from __future__ import annotations

import os
import socket
import webbrowser
from contextlib import suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING

import uvicorn

from invrender.app import store
from invrender.app.server import make_app
from invrender.types import InputError

if TYPE_CHECKING:
    from rich.console import Console

NOWHERE = ("192.0.2.1", 9)  # RFC 5737: nothing is sent, the system only chooses its own address
STOPPING = 2  # seconds that open pages get when the server stops


def serve(data: Path, *, port: int, lan: bool, browser: bool, console: Console) -> None:
    """Serve until interrupted. Raises `InputError` for a port or a folder that cannot be used."""
    if not 0 <= port <= 65535:
        raise InputError(f"a port is a number from 0 to 65535, not {port}")
    store.prepare(data)
    locked = lock(data)
    listening = listen("0.0.0.0" if lan else "127.0.0.1", port)
    port = listening.getsockname()[1]
    names = ["localhost", "127.0.0.1", *(own_addresses() if lan else [])]
    token = store.token(data)
    links = {"here": f"http://localhost:{port}/?token={token}"}
    if len(names) > 2:
        links["phone"] = f"http://{names[2]}:{port}/?token={token}"
        links["tablet"] = f"http://{names[2]}:{port}/tablet?token={token}"
    hosts = frozenset(f"{name}:{port}" for name in names)
    app = make_app(data, hosts, links, f"invrender-{port}")
    config = uvicorn.Config(
        app, log_level="critical", access_log=False, server_header=False, ws="none",
        timeout_graceful_shutdown=STOPPING, h11_max_incomplete_event_size=32768,
    )  # fmt: skip
    console.print(f"invrender app: {links['here']}")
    if lan:
        console.print(
            f"phone and tablet: {links.get('phone', 'no network was found')}\n"
            "The page is open to whoever in this network has that address, and is not encrypted."
        )
    console.print(f"captures: {data}\nCtrl-C ends it.")
    if browser:
        with suppress(webbrowser.Error):
            webbrowser.open(links["here"])
    try:
        uvicorn.Server(config).run(sockets=[listening])
    except KeyboardInterrupt:
        pass
    finally:
        locked.close()


def listen(address: str, port: int) -> socket.socket:
    """A socket on that port. Raises `InputError` where it is taken."""
    listening = socket.socket()
    if os.name == "posix":
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((address, port))
    except OSError as error:
        listening.close()
        raise InputError(
            f"port {port} cannot be used ({error.strerror}): another 'invrender app' may run; "
            "choose one with --port, 0 for any that is free"
        ) from None
    return listening


def own_addresses() -> list[str]:
    """This machine's addresses in its networks, the one towards the internet first."""
    found = []
    with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(NOWHERE)
        found.append(probe.getsockname()[0])
    name = socket.gethostname()
    with suppress(OSError):
        found += [str(info[4][0]) for info in socket.getaddrinfo(name, None, socket.AF_INET)]
    local = [f"{name.lower().removesuffix('.local')}.local"]
    return list(dict.fromkeys(a for a in found if not a.startswith("127."))) + local


def lock(data: Path) -> IO[bytes]:
    """Keep a second server off the data folder while the file is open. Raises `InputError`."""
    file = (data / "lock").open("wb")
    try:
        import fcntl
    except ImportError:  # Windows: the port keeps most of them apart
        return file
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        raise InputError(
            f"another 'invrender app' uses {data}: end it, or choose another folder with --data"
        ) from None
    return file
