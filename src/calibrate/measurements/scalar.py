"""What all observations of a single number share: a cavity's volume, a length."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Collection, Mapping
from typing import Any, ClassVar, Self

import numpy as np

from calibrate.measurements.protocol import Field, Labels
from calibrate.noise.protocol import Sites
from emulator.core.errors import InputError
from emulator.scenes.scene import Scene


class Scalar:
    """One number above 0, in a column or variable called as on the command line.

    A subclass gives ``unit``, ``nodes``, ``__call__``, ``default_noise``, ``parse`` and ``names``,
    the last of which ``parse`` understands.
    """

    kind: ClassVar[str]
    usage: ClassVar[str]
    shape: ClassVar[tuple[int, ...]] = ()
    sites: ClassVar[Sites | None] = None

    @property
    @abstractmethod
    def unit(self) -> str:
        """Unit of the number."""

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """Names it may have in a data file."""

    @classmethod
    @abstractmethod
    def parse(cls, scene: Scene, word: str, seed: int) -> tuple[str, Self] | None:
        """Name and observation of ``word``."""

    def check(self, name: str, values: np.ndarray) -> None:
        """Raise :class:`InputError` unless ``values`` is one finite number above 0, or missing."""
        self._check_number(name, values)
        if values <= 0.0:
            raise InputError(f"data: {name} is {values} {self.unit}; it must be above 0")

    def _check_number(self, name: str, values: np.ndarray) -> None:
        if values.shape != ():
            raise InputError(
                f"data has shape {values.shape}; the observation expects () ({name}, {self.unit})"
            )
        if np.isinf(values):
            raise InputError(f"data: {name} is {values}; it must be finite")

    def labels(self, name: str) -> Labels:
        """None: a number has no dimensions."""
        return Labels()

    def to_json(self) -> dict[str, Any]:
        """Kind and the word that asks for it."""
        return {"kind": self.kind, "word": self.names[-1]}

    @classmethod
    def from_json(cls, scene: Scene, description: Mapping[str, Any]) -> Self:
        """The observation that :meth:`to_json` described."""
        return cls._of(scene, description["word"])

    @classmethod
    def layouts(cls, words: Collection[str]) -> dict[str, tuple[Field, ...]]:
        """One column for each word ``<kind>`` or ``<kind>:...``."""
        return {w: (Field(w, (w,)),) for w in words if w.partition(":")[0] == cls.kind}

    @classmethod
    def from_arrays(
        cls, scene: Scene, name: str, arrays: Mapping[str, np.ndarray]
    ) -> tuple[Self, np.ndarray]:
        """Observation and data from the one array called ``name``."""
        if arrays[name].size != 1:
            found = cls._of(scene, name)
            raise InputError(f"{name} has {arrays[name].size} values; give one, in {found.unit}")
        return cls._of(scene, name), arrays[name].reshape(())

    def to_arrays(self, name: str, values: np.ndarray) -> dict[str, np.ndarray]:
        """The number under its name."""
        return {name: np.asarray(values)}

    @classmethod
    def _of(cls, scene: Scene, word: str) -> Self:
        found = cls.parse(scene, word, 0)
        if found is None:
            raise InputError(f"'{word}' is no {cls.kind}; write {cls.usage}")
        return found[1]
