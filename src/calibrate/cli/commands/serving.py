"""``calibrate serve`` and ``explore``: servers of a forward map, for programs and for people."""

from __future__ import annotations

import argparse
from typing import Any

from calibrate.cli.output import needing_plotly, serve_until_interrupted
from calibrate.cli.words import add_body, answer, emulator_of
from calibrate.local_server import LOOPBACK
from emulator.core.errors import InputError


def add_serve(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "serve",
        help="an emulator, or FEM, for other programs, by the UM-Bridge protocol",
        description="The model 'forward': theta to what is observed, with derivatives, for QUEENS, "
        "tinyDA, PyMC and whatever else speaks UM-Bridge. End with Ctrl-C.",
        epilog="example: calibrate serve left_ventricle --observe landmarks:24+volume",
    )
    add_body(parser)
    parser.add_argument("--fem", action="store_true", help="FEM of the scene instead")
    parser.add_argument(
        "--observe",
        metavar="WHAT",
        help="as for infer (default: the volumes of the scene's cavities, or landmarks:24)",
    )
    parser.add_argument("--port", type=int, default=4242, help="default 4242; 0 for a free one")
    parser.add_argument(
        "--host",
        default=LOOPBACK,
        help="default: this machine alone; 0.0.0.0 for all that reach it, without a password",
    )
    answer(parser, run_serve)


def run_serve(arguments: argparse.Namespace) -> int:
    """Serve until interrupted."""
    from calibrate.measurements import parse_observation
    from calibrate.um_bridge import NAME, serve
    from emulator.catalogue import find_scene
    from emulator.fem import Simulator
    from emulator.scenes.cavities import cavity_sets
    from emulator.surrogates.fem import fem_forward
    from emulator.surrogates.protocol import ForwardMap

    if arguments.fem and arguments.emulator:
        raise InputError("serve: --fem takes no --emulator")
    forward: ForwardMap
    if arguments.fem:
        forward = fem_forward(Simulator(find_scene(arguments.body)))
    else:
        forward = emulator_of(arguments).cache()
    scene = forward.scene
    default = "volume" if cavity_sets(scene) else "landmarks:24"
    observe = parse_observation(scene, arguments.observe or default)
    with serve(forward, observe, arguments.port, arguments.host) as server:
        model = server.subject
        address = f"http://{arguments.host}:{server.server_address[1]}"
        outputs = [
            {"name": name, "numbers": size, "unit": model.units[name]}
            for name, size in zip(model.units, model.output_sizes, strict=True)
        ]
        names = list(scene.parameter_names)
        result = {"address": address, "name": NAME, "input": names, "output": outputs}
        numbers = ", ".join("{name} ({numbers}, {unit})".format_map(each) for each in outputs)
        text = (
            f"{address}, model '{NAME}': {model.label} of {scene.name}\n"
            f"input: {', '.join(names)}\noutput: {numbers}\nCtrl-C ends it"
        )
        return serve_until_interrupted(arguments, server, result, text)


def add_explore(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "explore",
        help="a local page with a slider for every parameter",
        description="The body deforms live, by the cached emulator; cavity volume, pressure-volume "
        "curve and error bar beside it, and FEM on request. The page is served to this machine "
        "only; end with Ctrl-C.",
        epilog="example: calibrate explore left_ventricle",
    )
    add_body(parser)
    parser.add_argument("--port", type=int, default=0, help="default: a free one")
    parser.add_argument("--no-browser", action="store_true", help="print the address alone")
    answer(parser, run_explore)


def run_explore(arguments: argparse.Namespace) -> int:
    """Serve until interrupted."""
    with needing_plotly("exploring needs"):
        from calibrate.explorer import Explorer, serve

    explorer = Explorer(emulator_of(arguments))
    with serve(explorer, arguments.port) as server:
        address = f"http://{LOOPBACK}:{server.server_address[1]}/"
        result = {"scene": explorer.scene.name, "address": address}
        text = f"{explorer.scene.name}: {address} (Ctrl-C ends it)"
        page = "" if arguments.no_browser else address
        return serve_until_interrupted(arguments, server, result, text, page)
