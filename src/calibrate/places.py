"""Words that name files, as a kept run has them: it may be read from any folder."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any


def absolute(word: str, folder: Path = Path(), *, is_path: bool = True) -> str:
    """An absolute path from one relative to ``folder``."""
    return str((folder / word).resolve()) if is_path else word


def scene_place(word: str, folder: Path = Path()) -> str:
    """A scene's name as it is, its file as an absolute path; ``finer:`` stays before either."""
    refined = "finer:" * word.startswith("finer:")
    name = word.removeprefix(refined)
    if refined:
        return refined + scene_place(name, folder)
    return absolute(name, folder, is_path=name.endswith(".toml"))


def emulator_place(word: str | None, folder: Path = Path()) -> str | None:
    """A shipped name as it is, a folder as an absolute path."""
    from emulator.surrogates import shipped

    return word if word is None or word in shipped() else absolute(word, folder)


def prior_place(word: str, folder: Path = Path()) -> str | dict[str, Any]:
    """A name as it is; a file's content, because a kept run must not change with the file."""
    from calibrate.priors.population import read_population

    return asdict(read_population(folder / word)) if word.endswith(".json") else word
