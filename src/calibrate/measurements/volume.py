"""The volume of a cavity."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Self

import jax
import numpy as np

from calibrate.measurements.scalar import Scalar
from calibrate.noise.gaussian import GaussianNoise
from emulator.geometry.facets import Cavity
from emulator.scenes.cavities import find_cavity
from emulator.scenes.scene import Scene


@dataclass(frozen=True, eq=False)
class CavityVolume(Scalar):
    """The volume of a cavity, one number in mL.

    Parameters
    ----------
    scene : with the cavity in its mesh.
    facet_set : its wall; needed where the scene has several cavities.

    Raises
    ------
    InputError
        No such set, one that encloses nothing, or several cavities and no name.
    """

    scene: Scene
    facet_set: str | None = None

    kind: ClassVar[str] = "volume"
    usage: ClassVar[str] = "volume, volume:FACETSET"
    quantity: ClassVar[str] = "volume"
    unit: ClassVar[str] = "mL"
    other_units: ClassVar[Mapping[str, float]] = {"mm3": 1e-3, "L": 1e3, "m3": 1e6}
    default_noise: ClassVar[GaussianNoise] = GaussianNoise(sd=1.0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "facet_set", self.cavity.facet_set)

    @cached_property
    def cavity(self) -> Cavity:
        """The volume as a function of the wall's displacement."""
        return find_cavity(self.scene, self.facet_set)

    @property
    def nodes(self) -> np.ndarray:
        """Nodes of the cavity's wall, (k,)."""
        return self.cavity.nodes

    @property
    def names(self) -> tuple[str, ...]:
        """``volume`` and ``volume:<facet set>``."""
        return self.kind, f"{self.kind}:{self.facet_set}"

    def __call__(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Volume (...) in mL."""
        return self.cavity(displacement)

    @classmethod
    def parse(cls, scene: Scene, word: str, seed: int) -> tuple[str, Self] | None:
        """``volume`` of the only cavity, or ``volume:<facet set>``."""
        kind, _, facet_set = word.partition(":")
        return (word, cls(scene, facet_set or None)) if kind == cls.kind else None
