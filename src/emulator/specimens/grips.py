"""The grips of a testing machine, and the stresses that they add to a specimen's."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from emulator.core.errors import InputError
from emulator.core.store import read_arrays, save_arrays


@dataclass(frozen=True, eq=False)
class GripStresses:
    r"""The stresses that grips add to those of homogeneous states, as polynomials of theta.

    Of each state, :math:`P = P_h + |P_h| \sum_\alpha c_\alpha \varphi_\alpha(x)` with the
    homogeneous stress :math:`P_h` (Frobenius norm), theta's position x in its box, and the
    polynomials of :mod:`emulator.surrogates.polynomial`.

    degrees : the degrees (t, p) of each term.
    shares : the coefficients (t, m, 3, 3) of each state; NaN where a component acts on no grip.
    error : the root mean square error of a share at theta that no polynomial was fitted to.
    of : a hash of the specimen and its grips.
    """

    degrees: np.ndarray
    shares: np.ndarray
    error: float
    of: str

    def write(self, path: str | Path) -> None:
        """Write the polynomials to a safetensors file."""
        words = {"error": repr(self.error), "of": self.of}
        save_arrays(path, {"degrees": self.degrees, "shares": self.shares}, words)

    @classmethod
    def read(cls, path: str | Path) -> GripStresses:
        """Read the polynomials from a file; :class:`InputError` for a file of another kind."""
        arrays, words = read_arrays(path)
        if set(arrays) != {"degrees", "shares"} or set(words) != {"error", "of"}:
            raise InputError(f"{path} is not what grips do to a specimen; train its scene again")
        return cls(**arrays, error=float(words["error"]), of=words["of"])


@dataclass(frozen=True)
class Grips:
    """How a specimen was held.

    Parameters
    ----------
    size : the lengths of the piece between its grips along x, y and z, mm.
    held : ``clamped``, faces that do not deform, as in jaws or glued to plates; or ``hooks``, lines
        through the thickness that are pulled along the face's normal and slide across it freely,
        as on threads.
    hooks : the number of hooks of an edge.
    cells : the number of elements along the longest side; hooks take two for each, or more.
    marks : the side of the square in the middle in which stretches were measured, mm; ``None`` for
        stretches between the grips.
    """

    size: tuple[float, float, float]
    held: Literal["clamped", "hooks"] = "clamped"
    hooks: int = 5
    cells: int = 8
    marks: float | None = None
    learned: GripStresses | None = None

    def __post_init__(self) -> None:
        if len(self.size) != 3 or not all(0.0 < length < np.inf for length in self.size):
            raise InputError(f"grips: size is {self.size}; give three lengths above 0, in mm")
        if self.hooks < 2:
            raise InputError(f"grips: {self.hooks} hooks an edge; give 2 or more")
        if self.cells < 2:
            raise InputError(f"grips: {self.cells} cells along the longest side; give 2 or more")
        if self.marks is not None and not 0.0 < self.marks < max(self.size):
            raise InputError(
                f"grips: marks are {self.marks:g} mm apart; give a length above 0 and below that "
                "of the piece, or none if stretches are those of the grips"
            )
