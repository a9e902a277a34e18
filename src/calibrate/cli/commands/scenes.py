"""``calibrate scenes``."""

from __future__ import annotations

import argparse
import textwrap
from typing import Any

from calibrate.cli.common import DONE, emit, table

_WIDTH = 79


def register(commands: Any) -> None:
    """Add the command."""
    commands.add_parser("scenes", help="what is built in")


def run(arguments: argparse.Namespace) -> int:
    """List the built-in scenes and the emulators shipped for them."""
    from emulator.scenes import BUILT_IN
    from emulator.surrogates.files import shipped_for

    rows: list[dict[str, Any]] = []
    for name, make in sorted(BUILT_IN.items()):
        scene = make()
        rows.append(
            {
                "name": name,
                "nodes": len(scene.mesh.nodes),
                "elements": len(scene.mesh.elements),
                "law": scene.law.name,
                "parameters": [
                    {"name": p.name, "unit": p.unit, "low": p.low, "high": p.high, "scale": p.scale}
                    for p in scene.parameters
                ],
                "emulator_shipped": name in shipped_for(name),
                "emulators": shipped_for(name),
            }
        )
    emit(rows, as_json=arguments.json, text=_text(rows))
    return DONE


def _text(rows: list[dict[str, Any]]) -> str:
    """A line a scene, and under it its parameters and the emulators shipped."""
    head, *lines = table(
        ("scene", "nodes", "tetrahedra", "law"),
        [(r["name"], r["nodes"], r["elements"], r["law"]) for r in rows],
        _WIDTH,
    ).splitlines()
    found = [head]
    for line, row in zip(lines, rows, strict=True):
        found += [line, *_wrapped("parameters", _parameters(row["parameters"]))]
        found += _wrapped("emulators", row["emulators"] or ["none shipped; train one"])
    return "\n".join(found)


def _wrapped(name: str, entries: list[str]) -> list[str]:
    """``entries`` after ``name``, on lines that fit a terminal, no entry on two."""
    indent, joined = f"  {name}  ", ", ".join(each.replace(" ", "\0") for each in entries)
    rest = " " * len(indent)
    lines = textwrap.wrap(joined, _WIDTH, initial_indent=indent, subsequent_indent=rest)
    return [line.replace("\0", " ") for line in lines]


def _parameters(parameters: list[dict[str, Any]]) -> list[str]:
    """Names with their ranges; numbered ones of one range are given by the first and the last."""
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
