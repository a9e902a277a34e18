r"""The material card of one law in another program, and the checks that all programs share.

A law goes out only where a program's energy is ours. The one exception is the penalty U on the
change of volume, of which programs have their own. With one bulk modulus

.. math:: K = U''(1)

in both, the stresses of two penalties differ by a pressure of second order in :math:`J - 1`. A card
with another penalty is written only where K is at least :data:`LEAST_RATIO` times the shear modulus
at rest, and then says so.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.core.kept import kept
from emulator.geometry.mesh import Mesh
from emulator.mechanics.kinematics import Strain
from emulator.mechanics.laws.law import Law

LEAST_RATIO = 20.0
"""Least ratio of bulk to shear modulus at which another volumetric penalty is admitted."""

Values = Mapping[str, float]
"""Parameters of a law by name, in the law's units."""
SPLIT = dict.fromkeys(("neo_hookean", "neo_hookean_E_nu"), "its neo-Hookean energy is isochoric")
"""The refusals of compressible laws by programs that split every energy."""
ISOCHORIC_GUCCIONE = "its Guccione energy is of the isochoric strain, so that forces would differ"
"""The refusal of Guccione's law by the same programs."""


@dataclass(frozen=True)
class Form:
    """The form in which a program has a law.

    write : the function from the law's parameters to the text of the card.
    penalty : the program's energy of volume change where it differs from the law's, as a formula.
    differs : sentences on whatever else a reader of the card should know.
    """

    write: Callable[[Values], str]
    penalty: str = ""
    differs: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class ExportedBody:
    """A body at rest as other programs take it.

    mesh : the mesh in mm.
    fibres, sheets : the unit directions (m, 3) of the elements; None where the law reads none.
    """

    mesh: Mesh
    fibres: np.ndarray | None = None
    sheets: np.ndarray | None = None

    @property
    def axes(self) -> np.ndarray | None:
        """The directions of fibres and sheets, (m, 2, 3), a sheet across the fibre for none."""
        if self.fibres is None:
            return None
        sheets = self.sheets if self.sheets is not None else across_any(self.fibres)
        return np.stack([self.fibres, sheets], axis=1)


@dataclass(frozen=True)
class Program:
    """A finite element program.

    name : its word on the command line.
    title : its name, with the version whose manual or source the forms were taken from.
    suffix : the ending of a card's file name.
    units : the units of cards and meshes.
    forms : its form of each law that it has, by the law's name.
    refusals : the reason why it has no form of a law, by the law's name.
    write_body : the function that writes a body beside cards, and returns the names of its files.
    usage : how cards and bodies are used, for the README.
    """

    name: str
    title: str
    suffix: str
    units: str
    forms: Mapping[str, Form]
    write_body: Callable[[Path, ExportedBody], list[str]]
    usage: str
    refusals: Mapping[str, str] = field(default_factory=dict)


def form_of(program: Program, law: Law) -> Form:
    """Return the program's form of ``law``; :class:`InputError` where it has none."""
    if law.name in program.forms:
        return program.forms[law.name]
    reason = program.refusals.get(law.name, "it has no material of this energy")
    raise InputError(
        f"{program.title} cannot take law '{law.name}': {reason}; it takes "
        f"{', '.join(program.forms)}"
    )


def write_card(program: Program, law: Law, values: Values) -> str:
    """Return the text of a card: ``law`` with the parameters ``values``, in the program's units.

    Raises
    ------
    InputError
        The program has no such law, a parameter is missing, unknown or not admissible, or the law
        is too compressible for the program's penalty on the change of volume.
    """
    form = form_of(program, law)
    known = [quantity.name for quantity in law.quantities]
    for name in values:
        if name not in known:
            raise InputError(f"'{name}' is no parameter of law '{law.name}': {', '.join(known)}")
    for quantity in law.quantities:
        if quantity.name not in values:
            raise InputError(f"law '{law.name}' needs '{quantity.name}'")
        if (fault := quantity.value_fault(float(values[quantity.name]))) is not None:
            raise InputError(fault)
    plain = {name: float(values[name]) for name in known}
    if form.penalty:
        bulk, shear = moduli_at_rest(law, plain)
        if bulk < LEAST_RATIO * shear:
            raise InputError(
                f"law '{law.name}' has a bulk modulus of {bulk:.3g} kPa, {bulk / shear:.3g} times "
                f"its shear modulus; {program.title} resists changes of volume by {form.penalty}, "
                f"which gives its forces from {LEAST_RATIO:g} times on"
            )
    return form.write(plain)


def moduli_at_rest(law: Law, values: Values) -> tuple[float, float]:
    """Return the bulk modulus and the shear modulus from fibre to sheet, at rest, in kPa."""
    parameters = jnp.asarray([values[quantity.name] for quantity in law.quantities])
    bulk, shear = _curvatures(law)(parameters)
    return float(bulk), float(shear)


@kept
def _curvatures(law: Law) -> Callable[[jax.Array], jax.Array]:
    """Return the compiled function from the parameters (k,) to both moduli at rest, (2,)."""
    axes = jnp.eye(3)[:2]
    dilation, shear = jnp.eye(3) / 3.0, jnp.zeros((3, 3)).at[0, 1].set(1.0)

    def curvature(direction: jax.Array, parameters: jax.Array) -> jax.Array:
        def energy(amount: jax.Array) -> jax.Array:
            return law.energy(Strain(amount * direction, None, axes), *parameters)

        return jax.grad(jax.grad(energy))(jnp.zeros(()))

    directions = jnp.stack([dilation, shear])
    return jax.jit(lambda p: jax.vmap(curvature, (0, None))(directions, p))


def engineering(mu: float, lam: float) -> tuple[float, float]:
    """Return Young's modulus, in the unit of Lame's parameters, and Poisson's ratio."""
    return mu * (3.0 * lam + 2.0 * mu) / (lam + mu), lam / (2.0 * (lam + mu))


def digits(value: float) -> str:
    """Return a number with 13 digits, in the 20 characters that CalculiX reads at most."""
    return f"{value:.12e}"


def row(values: np.ndarray) -> str:
    """Return numbers separated by commas."""
    return ", ".join(map(digits, values))


def across_any(directions: np.ndarray) -> np.ndarray:
    """Return unit vectors (m, 3) across ``directions`` (m, 3), any of them."""
    least = np.eye(3)[np.argmin(np.abs(directions), axis=1)]
    vectors = np.cross(directions, least)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
