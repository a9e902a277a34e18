"""``calibrate serve`` and ``explore``: servers of a forward map, for programs and for people."""

from __future__ import annotations

import sys
import webbrowser
from argparse import ArgumentParser, Namespace
from functools import partial
from typing import TYPE_CHECKING

from calibrate.cli.output import check_plotly
from calibrate.cli.words import Answer, command, flag, option
from calibrate.local_server import LOOPBACK, Server
from emulator.core.errors import InputError

if TYPE_CHECKING:
    from emulator.surrogates.emulator import Emulator


def _add_body(parser: ArgumentParser) -> None:
    parser.add_argument(
        "body", metavar="EMULATOR|SCENE", help="an emulator's shipped name or folder, or a scene"
    )
    parser.add_argument(
        "--emulator", metavar="E", help="the scene's emulator: shipped name or folder"
    )


def _emulator_of(arguments: Namespace) -> Emulator:
    from emulator.catalogue import find_scene
    from emulator.surrogates import load

    body, word = arguments.body, arguments.emulator
    emulator = load(word or body)
    if word and find_scene(body).fingerprint != emulator.scene.fingerprint:
        raise InputError(
            f"--emulator {word} is of scene '{emulator.scene.name}', or of another mesh, not of "
            f"'{body}'"
        )
    return emulator


def _serve_until_interrupted(server: Server, page: str = "") -> None:
    """Open the page in a browser, if there is one, and serve until Ctrl-C."""
    if page:
        webbrowser.open(page)
    with server:
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            print("ended", file=sys.stderr)


@command(
    _add_body,
    flag("--fem", "FEM of the scene instead"),
    option(
        "--observe",
        "WHAT",
        "as for infer (default: the volumes of the scene's cavities, or landmarks:24)",
    ),
    option("--port", type=int, default=4242, help="default 4242; 0 for a free one"),
    option(
        "--host",
        default=LOOPBACK,
        help="default: this machine alone; 0.0.0.0 for all that reach it, without a password",
    ),
    help="an emulator, or FEM, for other programs, by the UM-Bridge protocol",
    description="The model 'forward': theta to what is observed, with derivatives, for QUEENS, "
    "tinyDA, PyMC and whatever else speaks UM-Bridge. End with Ctrl-C.",
    epilog="example: calibrate serve left_ventricle --observe landmarks:24+volume",
)
def serve(arguments: Namespace) -> Answer:
    """Serve until interrupted."""
    from calibrate.measurements import parse_observation
    from calibrate.um_bridge import NAME, serve
    from emulator.catalogue import find_scene
    from emulator.fem import Simulator
    from emulator.scenes.scene import cavity_sets, with_mesh
    from emulator.surrogates.fem import fem_forward
    from emulator.surrogates.protocol import ForwardMap

    if arguments.fem and arguments.emulator:
        raise InputError("serve: --fem takes no --emulator")
    forward: ForwardMap
    if arguments.fem:
        forward = fem_forward(Simulator(find_scene(arguments.body)))
    else:
        forward = _emulator_of(arguments).cache()
    scene = with_mesh(forward.scene)
    default = "volume" if cavity_sets(scene) else "landmarks:24"
    observe = parse_observation(scene, arguments.observe or default)
    server = serve(forward, observe, arguments.port, arguments.host)
    model = server.subject
    address = f"http://{arguments.host}:{server.server_address[1]}"
    outputs = [
        {"name": name, "numbers": size, "unit": model.units[name]}
        for name, size in zip(model.units, model.output_sizes, strict=True)
    ]
    names = list(scene.parameter_names)
    result = {"address": address, "name": NAME, "input": names, "output": outputs}
    numbers = ", ".join("{name} ({numbers}, {unit})".format_map(output) for output in outputs)
    text = (
        f"{address}, model '{NAME}': {model.label} of {scene.name}\n"
        f"input: {', '.join(names)}\noutput: {numbers}\nCtrl-C ends it"
    )
    return Answer(result, text, then=partial(_serve_until_interrupted, server))


@command(
    _add_body,
    option("--port", type=int, default=0, help="default: a free one"),
    flag("--no-browser", "print the address alone"),
    help="a local page with a slider for every parameter",
    description="The body deforms live, by the cached emulator; cavity volume, pressure-volume "
    "curve and error bar beside it, and FEM on request. The page is served to this machine "
    "only; end with Ctrl-C.",
    epilog="example: calibrate explore left_ventricle",
)
def explore(arguments: Namespace) -> Answer:
    """Serve until interrupted."""
    check_plotly("exploring")
    from calibrate.explorer import Explorer, serve

    explorer = Explorer(_emulator_of(arguments))
    server = serve(explorer, arguments.port)
    address = f"http://{LOOPBACK}:{server.server_address[1]}/"
    result = {"scene": explorer.scene.name, "address": address}
    text = f"{explorer.scene.name}: {address} (Ctrl-C ends it)"
    page = "" if arguments.no_browser else address
    return Answer(result, text, then=partial(_serve_until_interrupted, server, page))
