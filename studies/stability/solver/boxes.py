"""Corners of every built-in scene's parameter box, and twice outside it."""

from __future__ import annotations

import itertools
from functools import cache, partial

import jax.numpy as jnp
import numpy as np
from studies.stability.solver.case import CASES, SEED, Case

import emulator as em


@cache
def built_in(name: str) -> em.Scene:
    return em.scenes.BUILT_IN[name]()


def corners(count: int) -> list[tuple[int, ...]]:
    """All corners of a box of up to 3 sides; of more, both diagonal ends and six at random."""
    every = list(itertools.product((0, 1), repeat=count))
    if count <= 3:
        return every
    rng = np.random.default_rng(SEED)
    picked = rng.choice(np.arange(1, len(every) - 1), 6, replace=False)
    return [every[0], every[-1], *(every[k] for k in sorted(picked))]


def _corner(name: str, corner: tuple[int, ...], stretch: float) -> Case:
    scene = built_in(name)
    position = 0.5 + stretch * (np.array(corner, float) - 0.5)
    return Case(scene, np.asarray(scene.from_unit(jnp.asarray(position))))


for _name in em.scenes.BUILT_IN:
    for _bits in corners(len(em.scenes.BUILT_IN[_name](order=1).parameters)):
        _label = f"{_name}_" + "".join("lh"[bit] for bit in _bits)
        CASES[_label] = ("corners of the boxes", partial(_corner, _name, _bits, 1.0))
        CASES[_label + "_outside"] = (
            "twice outside the boxes",
            partial(_corner, _name, _bits, 2.0),
        )
