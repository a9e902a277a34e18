"""``calibrate scenes``."""

from __future__ import annotations

import argparse
from typing import Any

from calibrate.cli.common import DONE, add_json, emit, table


def register(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser("scenes", help="what is built in")
    add_json(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """List the built-in scenes and the emulators shipped for them."""
    from emulator.scenes import BUILT_IN
    from emulator.surrogates import shipped

    available = shipped()
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
                "emulator_shipped": name in available,
            }
        )
    text = table(
        ("scene", "nodes", "tetrahedra", "law", "parameters", "emulator"),
        [
            (
                r["name"],
                r["nodes"],
                r["elements"],
                r["law"],
                _parameters(r["parameters"]),
                "shipped" if r["emulator_shipped"] else "train it",
            )
            for r in rows
        ],
    )
    emit(rows, as_json=arguments.json, text=text)
    return DONE


def _parameters(parameters: list[dict[str, Any]]) -> str:
    """Names with their ranges; numbered ones of one range are given by the first and the last."""
    groups: dict[tuple[str, str], list[str]] = {}
    for p in parameters:
        about = f"{p['low']:g}-{p['high']:g} {p['unit']}".strip()
        base = p["name"].rstrip("0123456789")
        key = base if base.endswith("_") and base != p["name"] else p["name"]
        groups.setdefault((key, about), []).append(p["name"])
    return ", ".join(
        f"{names[0]} to {names[-1]} {about}" if len(names) > 1 else f"{names[0]} {about}"
        for (_, about), names in groups.items()
    )
