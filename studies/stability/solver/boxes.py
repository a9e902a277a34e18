"""Corners of every built-in scene's parameter box, twice outside it, and draws of wide priors."""

from __future__ import annotations

import itertools
from functools import cache, partial

import jax.numpy as jnp
import numpy as np
from studies.common.twins import wide_theta
from studies.stability.solver.case import CASES, SEED, Case

import emulator as em

DRAWS = 60  # of the wide prior of each scene


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


def _drawn(name: str, number: int) -> Case:
    scene = built_in(name)
    drawn = wide_theta(scene, np.random.default_rng([SEED, number]))
    return Case(scene, np.array([drawn[parameter] for parameter in scene.parameter_names]))


for _name in em.scenes.BUILT_IN:
    for _bits in corners(len(em.scenes.BUILT_IN[_name](order=1).parameters)):
        _label = f"{_name}_" + "".join("lh"[bit] for bit in _bits)
        CASES[_label] = ("corners of the boxes", partial(_corner, _name, _bits, 1.0))
        CASES[_label + "_outside"] = (
            "twice outside the boxes",
            partial(_corner, _name, _bits, 2.0),
        )
    for _number in range(DRAWS):
        CASES[f"{_name}_wide_{_number}"] = ("wide priors", partial(_drawn, _name, _number))
