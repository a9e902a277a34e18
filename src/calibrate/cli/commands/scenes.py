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
                ", ".join(
                    f"{p['name']} {p['low']:g}-{p['high']:g} {p['unit']}".strip()
                    for p in r["parameters"]
                ),
                "shipped" if r["emulator_shipped"] else "train it",
            )
            for r in rows
        ],
    )
    emit(rows, as_json=arguments.json, text=text)
    return DONE
