"""The folders of emulators: those that come with the package, and those of a user."""

from __future__ import annotations

from pathlib import Path

from emulator.core.errors import InputError
from emulator.core.store import read_json

SHIPPED = Path(__file__).parent.parent / "shipped"
KINDS = ("series", "physics")
"""Kinds of shipped emulators besides graph networks: Taylor series of FEM with what FEM runs taught
beside it, and polynomials that no simulation taught."""


def shipped() -> list[str]:
    """Return the names of the emulators that come with the package.

    An installed package lacks the weights of the largest ones, which a clone has.
    """
    return sorted(path.parent.name for path in SHIPPED.glob("*/weights.safetensors"))


def folder_of(name: str | Path) -> Path:
    """Return the folder of the emulator called ``name``, shipped or not."""
    shipped_folder, folder = SHIPPED / name, Path(name)
    if str(name) in shipped():
        return shipped_folder
    if (folder / "emulator.json").is_file():
        return folder
    if (shipped_folder / "emulator.json").is_file():
        record = read_json(shipped_folder / "emulator.json")["record"]
        raise InputError(
            f"the installed package has no weights of '{name}'; make them here in about "
            f"{record['seconds'] / 60.0:.0f} minutes: {record['command'][: -len('DIR')]}{name}"
        )
    raise InputError(
        f"emulator '{name}' is neither shipped nor a folder with emulator.json; "
        f"shipped: {', '.join(shipped()) or 'none'}"
    )
