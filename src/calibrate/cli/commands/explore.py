"""``calibrate explore``: the body under your sliders."""

from __future__ import annotations

import argparse
import sys
import webbrowser
from typing import Any

from calibrate.cli.common import DONE, emit, needing_plotly
from calibrate.cli.model_words import emulator_of


def register(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "explore",
        help="a local page with a slider for every parameter",
        description="The body deforms live, by the cached emulator; cavity volume, pressure-volume "
        "curve and error bar beside it, and FEM on request. The page is served to this machine "
        "only; end with Ctrl-C.",
        epilog="example: calibrate explore left_ventricle",
    )
    parser.add_argument(
        "body", metavar="EMULATOR|SCENE", help="an emulator's shipped name or folder, or a scene"
    )
    parser.add_argument("--emulator", metavar="E", help="of the scene: shipped name or folder")
    parser.add_argument("--port", type=int, default=0, help="default: a free one")
    parser.add_argument("--no-browser", action="store_true", help="print the address alone")


def run(arguments: argparse.Namespace) -> int:
    """Serve until interrupted."""
    with needing_plotly("exploring needs"):
        from calibrate.explorer import Explorer, serve
    from calibrate.local_server import LOOPBACK

    explorer = Explorer(emulator_of(arguments.body, arguments.emulator))
    with serve(explorer, arguments.port) as server:
        address = f"http://{LOOPBACK}:{server.server_address[1]}/"
        told = {"scene": explorer.scene.name, "address": address}
        text = f"{explorer.scene.name}: {address} (Ctrl-C ends it)"
        emit(told, as_json=arguments.json, text=text)
        sys.stdout.flush()
        if not arguments.no_browser:
            webbrowser.open(address)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            print("ended", file=sys.stderr)
    return DONE
