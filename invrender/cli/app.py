"""``invrender app``: the local page that leads a person through a capture."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

PORT = 8765


def add_parser(commands: Any) -> None:
    """Add the subcommand to argparse's subparsers."""
    parser = commands.add_parser(
        "app",
        help="a local page that leads through a capture, from the rig to the export",
        description="Serve a page to this machine's browser that leads through a capture: rig, "
        "tablet, photo, maps, export. Nothing leaves the machine. Captures are plain folders in "
        "--data; whoever has the address that is printed, which holds a key, may see and change "
        "them.",
    )
    parser.add_argument(
        "--lan",
        action="store_true",
        help="let tablet and phone in the same network open it too, by a QR code: the connection "
        "is not encrypted, so use it in a network whose people you trust",
    )
    parser.add_argument(
        "--data", type=Path, default=Path.home() / "invrender", help="folder (~/invrender)"
    )
    parser.add_argument("--port", type=int, default=PORT, help=f"({PORT}; 0: any that is free)")
    parser.add_argument("--no-browser", action="store_true", help="only print the address")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace, console: Console) -> int:
    """Run the subcommand."""
    from invrender.app.serve import serve

    serve(args.data, port=args.port, lan=args.lan, browser=not args.no_browser, console=console)
    return 0
