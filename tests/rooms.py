"""The rooms: what can be taken out of the packages, and the core still does its journey.

``python -m tests.rooms`` lists the imports by which the core and rooms reach into rooms, and the
lines of code of each.
"""

from __future__ import annotations

import ast
import io
import tokenize
from collections.abc import Iterator
from pathlib import Path

SRC = Path(__file__).resolve().parents[1] / "src"

ROOMS = {
    "hearts": ("emulator.hearts", "calibrate.cli.commands.meshing"),
    "networks": (
        "emulator.surrogates.network.body",
        "emulator.surrogates.network.family",
        "emulator.fem.linear_response",
        *(f"emulator.training.{name}" for name in ("physics", "sweeps", "paper", "families")),
    ),
    "specimens": (
        "emulator.specimens",
        *(f"calibrate.measurements.{name}" for name in ("specimens", "stress", "stretch", "tube")),
        "calibrate.statistical_model.gripped_fem",
        "calibrate.project.specimen",
    ),
    "viscosity": (
        "emulator.viscosity",
        "emulator.fem.through_time",
        "emulator.fem.after_time",
        "emulator.fem.history",
        "calibrate.measurements.in_time",
        "calibrate.statistical_model.finer_history",
        "calibrate.project.viscosity",
    ),
    "fields": (
        "calibrate.measurements.frame_checks",
        "calibrate.fields",
        "calibrate.measurements.frames",
        "calibrate.measurements.full_field",
        "calibrate.cli.commands.frames",
    ),
    "pages": ("calibrate.report", "calibrate.figures", "calibrate.explorer"),
    "serving": ("calibrate.um_bridge", "calibrate.local_server", "calibrate.cli.commands.serving"),
    "analyses": ("calibrate.analysis", "calibrate.cli.commands.analyses"),
    "populations": (
        "calibrate.population",
        "calibrate.project.members",
        "calibrate.project.cohort",
        "calibrate.cli.commands.cohort",
    ),
    "external": ("emulator.external", "calibrate.external"),
    "predictions": ("calibrate.prediction", "calibrate.cli.commands.prediction"),
    "neighbours": (
        "emulator.neighbours",
        "calibrate.neighbours",
        "calibrate.cli.commands.export",
    ),
    "released": (
        "emulator.released",
        "emulator.verify",
        "emulator.surrogates.released_network",
    ),
}
"""The modules and packages of each room."""

NEIGHBOURS = {
    "hearts": {"pages"},
    "analyses": {"released", "pages", "specimens"},
    "fields": {"hearts", "specimens"},
    "pages": {"analyses", "populations", "serving", "specimens"},
    "released": {"specimens"},
    "specimens": {"viscosity"},
    "viscosity": {"specimens"},
    "serving": {"pages"},
    "populations": {"pages", "specimens"},
    "predictions": {"pages", "populations", "specimens"},
}
"""The rooms that a room reaches into."""


def room_of(module: str) -> str | None:
    """Return the room that a module is in; None for the core."""
    for room, modules in ROOMS.items():
        if any(f"{module}.".startswith(f"{of}.") for of in modules):
            return room
    return None


def imports(*, on_import: bool = False) -> Iterator[tuple[str, str]]:
    """Yield every module of ``src`` and what it imports, but for types alone.

    on_import : whether to yield only what is imported with the module, not by a call.
    """
    for path in sorted(SRC.rglob("*.py")):
        module = ".".join(path.relative_to(SRC).with_suffix("").parts).removesuffix(".__init__")
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in tree.body if on_import else _outside_of_type_checking(tree):
            if isinstance(node, ast.ImportFrom) and node.module:
                yield from ((module, f"{node.module}.{name.name}") for name in node.names)


def _outside_of_type_checking(tree: ast.AST) -> Iterator[ast.AST]:
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            continue
        yield node
        yield from _outside_of_type_checking(node)


def reaching(*, on_import: bool = False) -> list[tuple[str, str, str, str]]:
    """Return importer's room or ``core``, the importer, the room imported and what is imported."""
    ways = []
    for module, of in imports(on_import=on_import):
        here, there = room_of(module), room_of(of)
        if there is not None and there != here:
            ways.append((here or "core", module, there, of))
    return ways


def code_lines(path: Path) -> int:
    """Return the lines of a file less blanks, comments and docstrings."""
    text = path.read_text(encoding="utf-8")
    lines = set[int]()
    skip = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT}
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in skip and token.type != tokenize.ENDMARKER:
            lines |= set(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        first = (
            node.body[0] if isinstance(getattr(node, "body", None), list) and node.body else None
        )
        for statement in [first, *getattr(node, "body", [])] if isinstance(first, ast.AST) else []:
            if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
                lines -= set(range(statement.lineno, (statement.end_lineno or 0) + 1))
    return len(lines)


def lines_of_rooms() -> dict[str, int]:
    """Return the lines of code of the core and of each room."""
    count = dict.fromkeys(["core", *ROOMS], 0)
    for path in SRC.rglob("*.py"):
        module = ".".join(path.relative_to(SRC).with_suffix("").parts).removesuffix(".__init__")
        count[room_of(module) or "core"] += code_lines(path)
    return count


def main() -> None:
    """Print lines of code and the imports between rooms."""
    for room, lines in lines_of_rooms().items():
        print(f"{room:12} {lines:6}")
    for way in reaching():
        print("{:12} {} -> {}: {}".format(*way))


if __name__ == "__main__":
    main()
