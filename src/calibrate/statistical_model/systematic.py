r"""What is unknown of a measurement itself: where a camera stood, how a marker was put.

Such an error is the same in many numbers: a camera that was moved between two loads shifts and
turns all markers of one state together. Left out, it passes for material. It is a
:class:`Systematic`, with the unknowns of which it consists in units of their sd, and a change of
the data for each; :func:`with_systematic` marginalises all of them
(:mod:`calibrate.statistical_model.error_modes`; those that are shares of what is predicted, or of a
size that is inferred, by :mod:`calibrate.statistical_model.varying_error`), so that sampling has no
more unknowns than before.
Small rotations are linear: an angle :math:`\omega` moves a point at x by
:math:`\omega \times (x - c)`, to second order in the angle.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jax.flatten_util import ravel_pytree

from calibrate.noise.information import information_about_means
from calibrate.statistical_model.error_modes import ErrorModes, Means, diagonal
from calibrate.statistical_model.model import Model
from calibrate.statistical_model.varying_error import VaryingError
from emulator.core.errors import InputError

_AXES = "xyz"
_VARYING = "varying_"  # before names of arrays
_SHARES = "of the prediction"  # in the words of what is kept


@dataclass(frozen=True, eq=False)
class Systematic:
    """An error that several numbers share.

    names : of its s unknowns, each a standard normal.
    modes : by the observation's name, what one sd of each changes of its data, (s, *shape).
    size : where the size of the error is inferred, its name in the posterior and the scale of its
        half-normal prior; modes are then those of size 1. Errors with one name have one size.
    shares : as modes, but each as a share of the data that is predicted; what one sd changes is the
        sum of both.
    """

    names: tuple[str, ...]
    modes: Mapping[str, np.ndarray]
    size: tuple[str, float] | None = None
    shares: Mapping[str, np.ndarray] = field(default_factory=dict)

    @property
    def varies(self) -> bool:
        """Whether what it changes depends on what is unknown."""
        return self.size is not None or any(np.any(each) for each in self.shares.values())


def rigid_motion(
    name: str,
    positions: Mapping[str, np.ndarray],
    shift: float | Sequence[float],
    turn: float | Sequence[float],
    about: Sequence[float] | None = None,
) -> Systematic:
    """A frame that was moved: all points of some observations shifted and turned together.

    Parameters
    ----------
    name : begins the names of its unknowns, ``camera shift x`` to ``camera turn z``.
    positions : by the observation's name, where its points were seen, (d, 3) mm; displacements of
        these points are what is measured.
    shift : sd along x, y and z in mm, or one for all.
    turn : sd about x, y and z in degrees, or one for all.
    about : (3,) mm, the point that only shifts; by default the mean of all positions.

    Raises
    ------
    InputError
        Positions of another shape, or a negative sd.
    """
    points = {key: np.asarray(each, dtype=float) for key, each in positions.items()}
    for key, each in points.items():
        if each.ndim != 2 or each.shape[1] != 3 or not np.isfinite(each).all():
            raise InputError(f"{name}: positions of '{key}' have shape {each.shape}; give (d, 3)")
    sds = [np.broadcast_to(np.asarray(sd, dtype=float), 3) for sd in (shift, turn)]
    if not all((sd >= 0.0).all() and np.isfinite(sd).all() for sd in sds):
        raise InputError(f"{name}: sds {shift} mm and {turn} degrees; they must be 0 or more")
    centre = np.concatenate(list(points.values())).mean(axis=0) if about is None else about
    modes = {}
    for key, each in points.items():
        shifts = [np.broadcast_to(sds[0][k] * axis, each.shape) for k, axis in enumerate(np.eye(3))]
        turns = [
            np.deg2rad(sds[1][k]) * np.cross(axis, each - centre)
            for k, axis in enumerate(np.eye(3))
        ]
        modes[key] = np.stack([*shifts, *turns])
    names = tuple(f"{name} {what} {axis}" for what in ("shift", "turn") for axis in _AXES)
    return Systematic(names, modes)


def placement(name: str, observed: Sequence[str], sd: np.ndarray) -> Systematic:
    """Every number has an offset of its own, the same in all observations of ``observed``.

    Such as where a marker was at rest, where displacements are from there.

    Parameters
    ----------
    sd : of each offset, of the shape of the data of each of these observations, in its unit.
    """
    sd = np.asarray(sd, dtype=float)
    each = np.diag(sd.ravel()).reshape(-1, *sd.shape)
    names = tuple(f"{name} {','.join(map(str, index))}" for index in np.ndindex(*sd.shape))
    return Systematic(names, dict.fromkeys(observed, each))


@dataclass(frozen=True, eq=False)
class SystematicError(ErrorModes):
    """All systematic errors of a model together; :func:`with_systematic` makes it.

    names : of their s unknowns that change known numbers by known amounts.
    mixing : (r, s), what the diagonal modes are made of.
    varying : the others, if there are any. Its information is what these leave, so that one after
        the other is exact.
    """

    names: tuple[str, ...]
    mixing: np.ndarray
    varying: VaryingError | None = None

    of_fem: ClassVar[bool] = True
    with_mesh: ClassVar[bool] = False

    @property
    def priors(self) -> dict[str, dist.Distribution]:
        """Of the size that is inferred."""
        return {} if self.varying is None else self.varying.priors

    def largest(self, means: Means) -> np.ndarray:
        """Modes of both kinds at their largest plausible size."""
        own = self.modes
        return own if self.varying is None else np.vstack([own, self.varying.largest(means)])

    def log_ratio(self, unknowns: jax.Array, residual: Means, means: Means) -> jax.Array:
        """What both kinds add to the log likelihood of ``residual``."""
        found = super().log_ratio(unknowns, residual, means)
        if self.varying is None:
            return found
        # Those of known numbers are in the other's information; what they say, they have said.
        return found + self.varying.log_ratio(unknowns, residual, means)

    def information_left(
        self, information: jax.Array, unknowns: jax.Array, means: Means
    ) -> jax.Array:
        """What both kinds leave of the noise's ``information`` (d, d)."""
        left = super().information_left(information, unknowns, means)
        if self.varying is None:
            return left
        return self.varying.information_left(left, unknowns, means)

    def draw(self, rng_key: jax.Array, unknowns: jax.Array, means: Means) -> dict[str, jax.Array]:
        """``means`` plus a draw of both kinds."""
        if self.varying is None:
            return super().draw(rng_key, unknowns, means)
        key, own = jax.random.split(rng_key)
        both = self.varying.draw(own, unknowns, means)
        alone = super().draw(key, unknowns, means)
        return {name: both[name] + alone[name] - means[name] for name in both}

    def unknowns(self, residual: Means) -> tuple[np.ndarray, np.ndarray]:
        """Mean (s,) and covariance (s, s) of the unknowns, in their sds, given ``residual``.

        ``residual`` is data less prediction at one draw of the parameters. Of errors that change
        known numbers alone: :class:`InputError` where one varies.
        """
        if self.varying is not None:
            of_size = f"the size '{self.varying.name}' is inferred"
            why = of_size if self.varying.name else "some are shares of what is predicted"
            raise InputError(f"what is known of errors: {why}")
        flat = np.asarray(ravel_pytree(dict(residual))[0])
        inflated = 1.0 + self.strength
        mean = self.mixing.T @ ((self.weights @ flat) / inflated)
        known = 1.0 - 1.0 / inflated
        return mean, np.eye(len(self.names)) - (self.mixing.T * known) @ self.mixing

    def arrays(self) -> dict[str, np.ndarray]:
        """All that changes a likelihood, by name."""
        names = ("weights", "strength", "modes", "mixing")
        found = {name: getattr(self, name) for name in names}
        own = {} if self.varying is None else self.varying.arrays()
        return found | {f"{_VARYING}{name}": array for name, array in own.items()}

    @property
    def words(self) -> dict[str, Any]:
        """What :meth:`restore` needs besides the arrays; plain JSON."""
        size = self.varying and self.varying.name
        return {"names": self.names, "size": size, "shares": _SHARES}

    @classmethod
    def restore(cls, arrays: Mapping[str, np.ndarray], words: Mapping[str, Any]) -> SystematicError:
        """The error of these :meth:`arrays` and :attr:`words`.

        Raises
        ------
        InputError
            It was kept when shares were of the data, which its arrays do not tell from others.
        """
        if words.get("shares") != _SHARES:
            raise InputError(
                "the posterior is older than systematic errors that are shares of predictions; "
                "infer again"
            )
        begins = len(_VARYING)
        own = {n[begins:]: a for n, a in arrays.items() if n.startswith(_VARYING)}
        known: dict[str, Any] = {n: a for n, a in arrays.items() if not n.startswith(_VARYING)}
        varying = VaryingError.restore(own, words["size"]) if own else None
        return cls(**known, names=tuple(words["names"]), varying=varying)


jax.tree_util.register_dataclass(
    SystematicError, ["weights", "strength", "modes", "mixing", "varying"], ["names"]
)


def with_systematic(model: Model, *errors: Systematic) -> Model:
    """``model`` whose data has these errors besides its noise.

    Raises
    ------
    InputError
        Nothing given, an observation that the model does not have or modes of another shape than
        its data, noise that is not Gaussian or of unknown sd, or a model that has another error.
    """
    if not errors:
        raise InputError("systematic errors: give one or more")
    return replace(model, error=systematic_error(model, errors, noise_information(model)))


def noise_information(model: Model) -> np.ndarray:
    """Information (d, d) of noise about the data's means, beside which there may be such errors.

    Raises
    ------
    InputError
        Noise that is not Gaussian or of unknown sd, or a model that has another error.
    """
    if model.error is not None:
        raise InputError("systematic errors: the model's likelihood has an error already")
    for name, noise in model.noise.items():
        if noise.priors or not noise.gaussian:
            raise InputError(
                f"systematic errors: the noise of {name} must be Gaussian and of known sd"
            )
    means = {name: jnp.zeros(shape) for name, shape in model.observe.shapes.items()}
    return np.asarray(jax.jit(lambda m: information_about_means(model.noise, m))(means))


def systematic_error(
    model: Model, errors: Sequence[Systematic], information: np.ndarray
) -> SystematicError:
    """All ``errors`` of the model's data together, beside noise of this ``information`` (d, d).

    Raises
    ------
    InputError
        An observation that the model does not have, or modes of another shape than its data.
    """
    for error in errors:
        _check_modes(model, error)
    known = [error for error in errors if not error.varies]
    weights, strength, modes, mixing = diagonal(_rows(model, known, "modes"), information)
    names = tuple(name for error in known for name in error.names)
    found = SystematicError(weights, strength, modes, names, mixing)
    left = found.information_left(jnp.asarray(information), jnp.zeros(0), {})
    return replace(found, varying=_varying(model, errors, np.asarray(left)))


def _varying(
    model: Model, errors: Sequence[Systematic], information: np.ndarray
) -> VaryingError | None:
    """Those of ``errors`` that vary, beside what leaves this ``information`` (d, d)."""
    those = [error for error in errors if error.varies]
    if not those:
        return None
    sizes = list(dict.fromkeys(error.size for error in those if error.size is not None))
    if len(sizes) > 1:
        raise InputError(
            f"systematic errors: sizes {sizes[0]} and {sizes[1]} are to be inferred; only one can "
            "be, by one name and scale"
        )
    (name, scale) = sizes[0] if sizes else ("", 0.0)
    if name in model.names:
        raise InputError(
            f"systematic errors: a size is called '{name}', as an unknown of the model"
        )
    sized = np.concatenate([np.full(len(e.names), float(e.size is not None)) for e in those])
    of_each = np.diagonal(information)
    alone = np.array_equal(information, np.diag(of_each))
    modes, shares = (_rows(model, those, kind) for kind in ("modes", "shares"))
    return VaryingError(modes, shares, sized, of_each if alone else information, name, scale)


def _check_modes(model: Model, error: Systematic) -> None:
    """:class:`InputError` where an error does not fit the model's observations."""
    parts = model.observe.parts
    for name, modes in (*error.modes.items(), *error.shares.items()):
        if name not in parts:
            raise InputError(
                f"{error.names[0]}: '{name}' is not observed; observed: {', '.join(parts)}"
            )
        if np.shape(modes) != (len(error.names), *parts[name].shape):
            raise InputError(
                f"{error.names[0]}: modes of '{name}' have shape {np.shape(modes)}; expected "
                f"{(len(error.names), *parts[name].shape)}"
            )


def _rows(model: Model, errors: Sequence[Systematic], kind: str) -> np.ndarray:
    """Modes or shares (s, d) of all data, raveled."""
    shapes = model.observe.shapes
    rows = [np.zeros((0, sum(int(np.prod(shape)) for shape in shapes.values())))]
    for error in errors:
        s = len(error.names)
        each = {name: np.zeros((s, *shape)) for name, shape in shapes.items()}
        each |= dict(getattr(error, kind))
        rows.append(np.hstack([np.reshape(e, (s, -1)) for e in jax.tree.leaves(each)]))
    return np.vstack(rows)
