"""``calibrate init``, ``scenes``, ``schema`` and ``completion``: scenes, and their files.

A schema and a completion are what editors and shells complete words from.
"""

from __future__ import annotations

import argparse
import textwrap
from argparse import Namespace
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibrate.cli.output import table
from calibrate.cli.words import Answer, command, option
from emulator.core.errors import InputError
from emulator.core.rooms import offered
from emulator.core.store import to_json

if TYPE_CHECKING:
    from emulator.scenes.scene import Scene
    from emulator.specimens.tube import Tube

_SOLVED_SOON = 20_000  # nodes of a mesh on which a solve takes seconds
_FAR = 0.15  # of the body's length


@command(
    option(
        "mesh",
        "FILE",
        "mesh of tetrahedra, the table of a specimen's test, or the input deck of FEBio, Abaqus, "
        "CalculiX or svMultiPhysics",
    ),
    option("--out", "FILE.toml", "file to write (default: beside the first); of a deck, or DIR"),
    option(
        "--unit",
        "mm|cm|m|um",
        "of the mesh's coordinates (default: guessed, and said); of a deck with that of stresses, "
        "as in mm,MPa (default: kPa)",
    ),
    option(
        "--law",
        "NAME",
        "laws, or tissues for the laws that are used for them (artery, brain, myocardium, rubber, "
        "skin); of several, files each (default: by whether there are fibres)",
        nargs="+",
        default=[],
    ),
    option(
        "--tube",
        "RADIUS,LAYER[,...]",
        "of a table of a tube: inner radius of the sector that it opens to, thickness of each "
        "layer from the inside, mm",
    ),
    option(
        "--inputs",
        "COLUMN",
        "of a table of a solver's runs: the columns of its parameters, or the number of the first "
        "columns that are; the others are outputs",
        nargs="+",
        default=[],
    ),
    help="first files for your mesh, or for the table of a test",
    description="Reads a mesh (gmsh, VTU and whatever meshio reads), says which sets it has, "
    "guesses from their names and from its size, says so, and writes a commented scene file. Of a "
    "table (CSV or xlsx) of stretches and stresses it writes a scene and an experiment file.",
    epilog="example: calibrate init ventricle.msh, then calibrate simulate ventricle.toml",
)
def init(arguments: Namespace) -> Answer:
    """Write the files of one law, or of each of several."""
    from emulator.core.cells import OTHER_SPREADSHEETS, SPREADSHEETS, TEXT
    from emulator.scenes.tissue_priors import laws_named

    source, laws = Path(arguments.mesh), laws_named(arguments.law)
    out = Path(arguments.out or source.parent / f"{source.stem or 'scene'}.toml")
    is_table = source.suffix.lower() in (*TEXT, *SPREADSHEETS, *OTHER_SPREADSHEETS)
    draft = _init_specimen if is_table else _init_scene
    if arguments.inputs:
        return _init_runs(source, out, arguments)
    for reader_of in offered("emulator.neighbours.decks.draft", "reader_of"):
        if reader_of(source) is not None:
            return _init_deck(source, arguments)
    if len(laws) < 2:
        return draft(source, out, laws[0] if laws else None, arguments)
    answers, reasons = dict[str, Answer](), dict[str, str]()
    for law in laws:
        try:
            file = out.with_name(f"{out.stem}_{law}{out.suffix}")
            answers[law] = draft(source, file, law, arguments)
        except InputError as reason:
            reasons[law] = str(reason)
    if not answers:
        raise InputError(reasons[laws[0]])
    result = {"laws": {law: answer.result for law, answer in answers.items()}, "left_out": reasons}
    files = [answer.result["out"] for answer in answers.values()]
    first = next(iter(answers.values())).text.splitlines()[:-1]  # what is alike is said once
    lines = [
        *(line for line in first if not line.startswith("law ")),
        *(f"law {law}: {answer.result['out']}" for law, answer in answers.items()),
        *(f"law {law} is left out: {reason}" for law, reason in reasons.items()),
        f"look for CHANGE in the scenes, then: calibrate infer {' '.join(files)} --out RUNS",
    ]
    return Answer(result, "\n".join(lines))


def _init_runs(table: Path, out: Path, arguments: Namespace) -> Answer:
    """Write the file of a table of runs, and list its parameters and outputs."""
    from calibrate.external.draft import draft_of_table

    for name in ("unit", "law", "tube"):
        if getattr(arguments, name):
            raise InputError(f"--{name} has no effect beside --inputs")
    draft = draft_of_table(table, out, arguments.inputs)
    lines = [
        f"parameters: {', '.join(draft.parameters)}",
        f"outputs: {', '.join(draft.outputs)}",
        *draft.notes,
        f"written to {draft.path}; then: calibrate infer {draft.path} --data DATA.csv --noise "
        f"{draft.outputs[0]}=SD --out RUN",
    ]
    result = draft._asdict() | {"path": str(draft.path)}
    return Answer(result, "\n".join(lines))


def _init_scene(mesh_path: Path, out: Path, law: str | None, arguments: Namespace) -> Answer:
    """Write the scene file, and describe the mesh."""
    from emulator.scenes.draft import draft_scene

    if arguments.tube is not None:
        raise InputError("--tube is for a table of stretches and pressures, not for a mesh")
    draft = draft_scene(mesh_path, out, unit=arguments.unit, law=law)
    notes = [*draft.notes, *_weight_notes(draft.scene)]
    return _of_scene(draft.path, draft.scene, notes, "look for CHANGE in it, then: ")


def _init_deck(deck: Path, arguments: Namespace) -> Answer:
    """Write mesh and scene of another program's deck, and list what was not understood."""
    from emulator.neighbours.decks.draft import draft_deck

    for name in ("law", "tube"):
        if getattr(arguments, name):
            raise InputError(f"--{name} has no effect on a deck, which has its own law and loads")
    draft = draft_deck(deck, Path(arguments.out or deck.parent), arguments.unit)
    answer = _of_scene(draft.path, draft.scene, [*draft.notes, *draft.unread], "then: ")
    return Answer({**answer.result, "unread": list(draft.unread)}, answer.text)


def _of_scene(path: Path, scene: Scene, notes: list[str], then: str) -> Answer:
    """Return what a scene file that was written has."""
    mesh = scene.mesh
    facets = {name: len(rows) for name, rows in mesh.facet_sets.items()}
    result = {
        "out": str(path),
        "nodes": len(mesh.nodes),
        "elements": len(mesh.elements),
        "node_sets": {name: len(nodes) for name, nodes in mesh.node_sets.items()},
        "facet_sets": facets,
        "law": scene.law.name,
        "parameters": list(scene.parameter_names),
        "notes": notes,
    }
    sets = [f"{n} ({k} facets)" for n, k in facets.items()]
    sets += [f"{n} ({len(k)} nodes)" for n, k in mesh.node_sets.items() if n not in facets]
    lines = [
        f"{len(mesh.nodes)} nodes, {len(mesh.elements)} tetrahedra",
        f"sets: {', '.join(sets) or 'none'}",
        *notes,
        f"written to {path}; {then}calibrate simulate {path}",
    ]
    return Answer(result, "\n".join(lines))


def _weight_notes(scene: Scene) -> Iterator[str]:
    """Say how far its own weight, the load for lack of another, moves a body that is too soft."""
    import numpy as np

    from emulator.fem import Simulator

    nodes = scene.mesh.nodes
    if scene.load_parameters or len(nodes) > _SOLVED_SOON:  # a guessed pressure is a parameter
        return
    remedy = "raise the medians of its moduli, hold it elsewhere, or give the load that you know"
    solution = Simulator(scene).solve(scene.centre)
    if not solution.converged:
        yield f"CHANGE: FEM finds no equilibrium under its own weight: {remedy}"
        return
    fall = float(np.linalg.norm(solution.displacement, axis=1).max())
    size = float(np.ptp(nodes, axis=0).max())
    if fall > _FAR * size:
        yield f"CHANGE: its own weight moves it by {fall:.3g} of {size:.3g} mm: {remedy}"


def _init_specimen(table_path: Path, out: Path, law: str | None, arguments: Namespace) -> Answer:
    """Write the files for a table, and list the guesses."""
    from calibrate.project.specimen import draft_specimen
    from emulator.scenes.tissue_priors import LAWS_OF_TISSUES

    if arguments.unit is not None:
        raise InputError(
            "--unit has no effect on a table: its columns have units, 'stress_x [MPa]'"
        )
    tube = None if arguments.tube is None else _tube(arguments.tube)
    tissue = next((word for word in arguments.law if law in LAWS_OF_TISSUES.get(word, ())), None)
    draft = draft_specimen(table_path, out, law=law, tissue=tissue, tube=tube)
    result = {
        "out": str(draft.path),
        "scene": str(draft.scene_path),
        "states": len(draft.scene.measured.free),
        "law": draft.scene.law.name,
        "parameters": list(draft.scene.parameter_names),
        "notes": list(draft.notes),
    }
    lines = [
        *draft.notes,
        f"written to {draft.path} and {draft.scene_path}; look for CHANGE in the latter, then: "
        f"calibrate infer {draft.path} --out RUN",
    ]
    return Answer(result, "\n".join(lines))


def _tube(text: str) -> Tube:
    """Return the sector that ``RADIUS,LAYER,...`` describes."""
    from emulator.specimens.tube import Tube

    try:
        radius, *layers = map(float, text.split(","))
    except ValueError:
        raise InputError(
            f"--tube '{text}'; give the sector's inner radius and the thickness of each layer in "
            "mm, such as --tube 4.2,0.9"
        ) from None
    return Tube(radius, tuple(layers))


_WIDTH = 79


@command(
    option(
        "name",
        "SCENE|EMULATOR",
        "one scene, with the card of each emulator shipped for it, or one emulator",
        nargs="?",
    ),
    help="what is built in; of one, the cards of its emulators",
    description="Lists the built-in scenes and the emulators shipped for them. Of one it prints "
    "the emulators' cards: what they are, how they were trained and over which theta, the errors "
    "that their training recorded, the licence and the digest of their weights.",
    epilog="example: calibrate scenes left_ventricle",
)
def scenes(arguments: Namespace) -> Answer:
    """List the built-in scenes and the emulators shipped for them, or describe one of either."""
    from emulator.core.errors import check_known
    from emulator.core.store import read_json
    from emulator.scenes import BUILT_IN
    from emulator.surrogates.folders import SHIPPED, shipped

    origins = {name: read_json(SHIPPED / name / "emulator.json")["scene"] for name in shipped()}
    name = arguments.name
    if name is not None:
        if not (SHIPPED / name / "emulator.json").is_file():
            check_known(name, sorted({*BUILT_IN, *origins}), "scene or emulator")
        if name not in BUILT_IN:
            return _cards([name])
    rows: list[dict[str, Any]] = []
    for scene_name in sorted(BUILT_IN) if name is None else [name]:
        scene = BUILT_IN[scene_name]()
        emulators = [n for n, origin in origins.items() if origin.get("scene") == scene_name]
        rows.append(
            {
                "name": scene_name,
                "nodes": len(scene.mesh.nodes),
                "elements": len(scene.mesh.elements),
                "law": scene.law.name,
                "parameters": [
                    {"name": p.name, "unit": p.unit, "low": p.low, "high": p.high, "scale": p.scale}
                    for p in scene.parameters
                ],
                "emulator_shipped": scene_name in emulators,
                "emulators": emulators,
            }
        )
    if name is None:
        return Answer(rows, _scenes_in_words(rows))
    cards = _cards(rows[0]["emulators"])
    text = "\n\n".join(filter(None, (_scenes_in_words(rows), cards.text)))
    return Answer([rows[0] | {"cards": cards.result}], text)


def _cards(names: list[str]) -> Answer:
    """Return the cards of shipped emulators."""
    from emulator.surrogates.card import model_card

    cards = [model_card(name)._asdict() for name in names]
    return Answer(cards, "\n\n".join(map(_card_in_words, cards)))


def _card_in_words(card: dict[str, Any]) -> str:
    """Return a card as lines that fit a terminal, without what its training did not record."""
    counts = {"fem_runs": "FEM runs", "sweeps": "sweeps", "steps": "steps", "bodies": "bodies"}
    trained = [f"recipe {card['recipe']}", f"seed {card['seed']}"]
    known = {key: n for key in counts if (n := card[key]) or (n == 0 and key == "fem_runs")}
    trained += [f"{number} {counts[key]}" for key, number in known.items()]
    machine = card["hardware"] or {}
    if card["seconds"] is not None:
        cores = f" on {machine['cores']} cores" if "cores" in machine else ""
        trained.append(f"{card['seconds']:.0f} s{cores}")
    errors = [
        f"{e['quantity'].partition(',')[0]} at {e['where']}: {e['statistic']} {e['value']:.2g}"
        f"{e['quantity'].partition(',')[2]}"
        for e in card["errors"]
    ]
    lines = [f"{card['name']}, an emulator of {card['scene']}"]
    for title, entries in {
        "parts": card["parts"],
        "trained": trained,
        "theta": _parameters(card["theta"]),
        "error": errors or ["not recorded"],
        "licence": [card["licence"] or "none stated"],
    }.items():
        lines += _wrapped(title.ljust(7), entries)
    lines += [f"  made by  {card['command']}"] if card["command"] else []
    lines += [] if errors else [f"  error by calibrate evaluate {card['name']} --against fem"]
    return "\n".join([*lines, f"  sha256   {card['weights_sha256']}"])


def _scenes_in_words(rows: list[dict[str, Any]]) -> str:
    """Return a line for each scene, and under it its parameters and shipped emulators."""
    head, *lines = table(
        ("scene", "nodes", "tetrahedra", "law"),
        [(r["name"], r["nodes"], r["elements"], r["law"]) for r in rows],
        _WIDTH,
    ).splitlines()
    text_lines = [head]
    for line, row in zip(lines, rows, strict=True):
        text_lines += [line, *_wrapped("parameters", _parameters(row["parameters"]))]
        text_lines += _wrapped("emulators", row["emulators"] or ["none shipped; train one"])
    return "\n".join(text_lines)


def _wrapped(name: str, entries: list[str]) -> list[str]:
    """Return ``entries`` after ``name``, on lines that fit a terminal, no entry on two."""
    indent, joined = f"  {name}  ", ", ".join(entry.replace(" ", "\0") for entry in entries)
    rest = " " * len(indent)
    lines = textwrap.wrap(joined, _WIDTH, initial_indent=indent, subsequent_indent=rest)
    return [line.replace("\0", " ") for line in lines]


def _parameters(parameters: list[dict[str, Any]]) -> list[str]:
    """Return names with their ranges; of numbered ones of one range, the first and the last."""
    groups: dict[tuple[str, str], list[str]] = {}
    for p in parameters:
        about = f"{p['low']:g} to {p['high']:g} {p['unit']}".strip()
        base = p["name"].rstrip("0123456789")
        key = base if base.endswith("_") and base != p["name"] else p["name"]
        groups.setdefault((key, about), []).append(p["name"])
    return [
        f"{names[0]} ... {names[-1]} {about}" if len(names) > 1 else f"{names[0]} {about}"
        for (_, about), names in groups.items()
    ]


@command(
    option(
        "file",
        nargs="?",
        choices=("scene", "experiment"),
        default="scene",
        help="kind of file (default: scene)",
    ),
    help="JSON Schema of scene or experiment files, for editors",
    description="Prints the JSON Schema of scene files: their keys, kinds of laws, loads and "
    "supports, with units and descriptions; or of experiment files: kinds of noise, systematic "
    "errors, forward maps and samplers. Editors complete and check a file that begins "
    "with the line '#:schema ./scene.schema.json'.",
    epilog="examples: calibrate schema > scene.schema.json; "
    "calibrate schema experiment > experiment.schema.json",
)
def schema(arguments: Namespace) -> Answer:
    """Return the schema, which is JSON with and without ``--json``."""
    if arguments.file == "scene":
        from emulator.scenes.file_schema import scene_schema as schema_of_file
    else:
        from calibrate.project.experiment import experiment_schema as schema_of_file
    schema = schema_of_file()
    return Answer(schema, to_json(schema))


@command(
    option("shell", choices=("bash", "zsh", "fish")),
    help="script that completes calibrate's words in your shell",
    description="Prints a script for bash, zsh or fish that completes commands, options, "
    "scenes, emulators, samplers, recipes and files, without starting calibrate.",
    epilog='bash: eval "$(calibrate completion bash)" in ~/.bashrc; zsh: calibrate completion '
    "zsh > a folder of $fpath/_calibrate; fish: calibrate completion fish > "
    "~/.config/fish/completions/calibrate.fish",
)
def completion(arguments: Namespace) -> Answer:
    """Return the script, made from the parsers of all commands."""
    import shtab

    from calibrate.cli import build_parser
    from emulator.mechanics.laws import LAWS
    from emulator.scenes import BUILT_IN
    from emulator.surrogates.folders import KINDS, shipped

    of_words = {
        "SCENE": _words([*BUILT_IN], "toml"),
        "EMULATOR": _words(shipped()),
        "NAME|DIR": _words([*KINDS, *shipped()]),
        "SCENE|EMULATOR": _words(sorted({*BUILT_IN, *shipped()})),
        "DIR|fem": _words(["fem"]),
        "synthetic": _words(["synthetic"], "csv"),
    }
    complete = {metavar: shtab.cmd(texts) for metavar, texts in of_words.items()}
    complete |= dict.fromkeys(("MESH", "NAME|FILE", "FILE|synthetic"), shtab.FILE)
    parser = build_parser()
    for action in _actions(parser):
        metavar = str(action.metavar)
        if metavar in complete:
            action.complete = complete[metavar]  # type: ignore[attr-defined]
        elif metavar.startswith("DIR"):
            action.complete = shtab.DIRECTORY  # type: ignore[attr-defined]
        elif metavar.startswith("FILE"):
            action.complete = shtab.FILE  # type: ignore[attr-defined]
        elif action.dest == "law":
            action.complete = shtab.cmd(_words([*LAWS]))  # type: ignore[attr-defined]
    script = shtab.complete(parser, arguments.shell)
    return Answer({"script": script}, script)


def _words(names: list[str], suffix: str = "") -> str:
    """Return a command of any shell that prints names, and files here that end in ``suffix``."""
    print_names = f"printf '%s\\n' {' '.join(sorted(names))}"
    files = f"ls | grep '\\.{suffix}$'" if suffix else "ls -d */ 2>/dev/null"
    return f"{print_names}; {files}"


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """Yield every argument of a parser and of its commands."""
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from _actions(command)
