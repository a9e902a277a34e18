"""Emulators of one body on two meshes."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import emulator as em

_ON_MESH = replace(em.recipe("mechanics"), simulations=200)


class Pair(NamedTuple):
    """Emulators of a scene, and of it on the next finer mesh."""

    coarse: em.Emulator
    fine: em.Emulator


def on_mesh(scene: em.Scene, folder: Path) -> em.Emulator:
    """Trained on ``scene``, from 200 runs and a series."""
    return em.train(scene, _ON_MESH, folder)


def on_two_meshes(scene: em.Scene, folder: Path) -> Pair:
    """Trained on ``scene``, then taken to its finer mesh by a few runs there."""
    coarse = on_mesh(scene, folder)
    plan = em.recipe("two_meshes")
    return Pair(coarse, em.train(em.finer(scene).scene, plan, folder / "finer", start=coarse))
