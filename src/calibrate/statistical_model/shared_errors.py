r"""Systematic errors in words: each is a table of an experiment file, kept in ``run.json``.

A kind says what is unknown of a measurement in the terms of who measured; from the observations and
their data it makes a :class:`~calibrate.statistical_model.systematic.Systematic`. What is a share,
a gain's or a curve's, is one of the prediction. Modes are else fixed numbers, so where one depends
on what the body does (where a marker was seen), the data says it, and it is off by the noise of a
datum: an angle of a degree makes a sixtieth of the noise of that.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol

import jax
import numpy as np

from calibrate.measurements.points import DisplacementPoints
from calibrate.measurements.present import Present
from calibrate.state_names import split
from calibrate.statistical_model.curve import check_curve, curve_modes
from calibrate.statistical_model.model import Model
from calibrate.statistical_model.systematic import (
    Systematic,
    SystematicError,
    noise_information,
    placement,
    rigid_motion,
    systematic_error,
)
from emulator.core import schema
from emulator.core.errors import InputError, look_up

CURVE_SHARE = "curve_share"
Vector = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Seen:
    """What errors are of: a model without missing values, and its data by name."""

    model: Model
    data: Mapping[str, np.ndarray]

    def named(self, words: str) -> list[str]:
        """Observations that words joined by ``+`` name, each in one load state or in all."""
        wanted = dict.fromkeys(words.split("+"), True)
        return list(self.model.observe.expand(wanted, "of"))

    def whole(self, name: str) -> tuple[Any, np.ndarray]:
        """The observation with all its entries, and its data; NaN where missing."""
        part, data = self.model.observe.parts[name], np.asarray(self.data[name])
        return (part.whole, part.filled(data)) if isinstance(part, Present) else (part, data)

    def points(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Points at rest and their displacements, 0 where missing, both (d, 3) mm."""
        part, data = self.whole(name)
        if not isinstance(part, DisplacementPoints):
            raise InputError(f"of: '{name}' is no displacement of points ({part.quantity})")
        return part.points, np.nan_to_num(data)

    def known(self, parameter: str, name: str) -> float:
        """The known value of ``parameter`` in the load state of observation ``name``."""
        scene, states = self.model.forward.scene, self.model.states
        if parameter not in scene.parameter_names:
            names = ", ".join(scene.parameter_names)
            raise InputError(f"along: '{parameter}' is no parameter; there are {names}")
        row = states.entries[states.states.index(split(name)[1])]
        value = row[scene.parameter_names.index(parameter)]
        if isinstance(value, str):
            raise InputError(f"along: '{value}' is not known; give its value as known")
        return value

    def present(self, error: Systematic) -> Systematic:
        """``error`` in the entries that are not missing."""

        def kept(modes: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
            left = dict(modes)
            for name, each in modes.items():
                part = self.model.observe.parts[name]
                if isinstance(part, Present):
                    left[name] = each.reshape(len(each), -1)[:, part.entries]
            return left

        return replace(error, modes=kept(error.modes), shares=kept(error.shares))


class SharedError(Protocol):
    """A kind of systematic error; its fields are what a file says of it."""

    def systematic(self, name: str, seen: Seen) -> Systematic:
        """The error called ``name``; :class:`InputError` where it does not fit what was seen."""
        ...


@dataclass(frozen=True)
class RigidMotion:
    """Points shifted and turned together: a camera or a clamp that moved, a hand that held.

    of : observations of displacements, joined by ``+``.
    shift : sd along x, y and z, mm; one for all, or three.
    turn : sd about x, y and z, degrees; one for all, or three.
    about : point that only shifts, mm; by default the mean of all points.
    at : where the points are when their frame moves: ``loaded``, where they were seen, or ``rest``.
    """

    of: str
    shift: float | Vector = 0.0
    turn: float | Vector = 0.0
    about: Vector | None = None
    at: Literal["loaded", "rest"] = "loaded"

    def systematic(self, name: str, seen: Seen) -> Systematic:
        """Three shifts and three turns."""
        places = {}
        for each in seen.named(self.of):
            points, moved = seen.points(each)
            places[each] = points + moved if self.at == "loaded" else points
        return rigid_motion(name, places, self.shift, self.turn, self.about)


@dataclass(frozen=True)
class Placement:
    """Numbers with offsets of their own, each the same in all the observations.

    of : observations with as many numbers each, joined by ``+``.
    sd : of each offset, in the unit of the data.
    rows : points that have one, counted from 0; by default all.
    """

    of: str
    sd: float
    rows: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        _check({"sd": self.sd})

    def systematic(self, name: str, seen: Seen) -> Systematic:
        """An offset a number."""
        observed = seen.named(self.of)
        shapes = {np.shape(seen.whole(each)[1]) for each in observed}
        if len(shapes) > 1:
            raise InputError(f"of: {', '.join(observed)} have different numbers of points")
        sd = np.zeros(shapes.pop())
        rows = range(len(sd) if sd.ndim else 1) if self.rows is None else self.rows
        for row in rows:
            if not 0 <= row < len(np.atleast_1d(sd)):
                raise InputError(f"rows: there is no point {row}; they are counted from 0")
            sd[row if sd.ndim else ()] = self.sd
        found = placement(name, observed, sd)
        kept = np.flatnonzero(np.ravel(sd))
        modes = {each: modes[kept] for each, modes in found.modes.items()}
        return Systematic(tuple(found.names[k] for k in kept), modes)


@dataclass(frozen=True)
class Pins:
    r"""Markers that stand elsewhere in the body's frame than the file says, all by one offset.

    Where their surface has turned by R, as their data says, an offset d moves a marker by
    :math:`(R - I)\,d` more.

    of : observations of three markers or more, joined by ``+``.
    sd : of the offset along each axis, mm.
    """

    of: str
    sd: float

    def __post_init__(self) -> None:
        _check({"sd": self.sd})

    def systematic(self, name: str, seen: Seen) -> Systematic:
        """One offset along each axis."""
        modes = {}
        for each in seen.named(self.of):
            points, moved = seen.points(each)
            if len(points) < 3 or np.linalg.matrix_rank(points - points.mean(axis=0)) < 2:
                raise InputError(f"of: '{each}' has no three markers, not on one line")
            rows = self.sd * (turned(points, moved) - np.eye(3)).T
            modes[each] = np.repeat(rows[:, None], len(points), axis=1)
        return Systematic(tuple(f"{name} {axis}" for axis in "xyz"), modes)


@dataclass(frozen=True)
class Gain:
    """All the data larger or smaller by one factor: a load cell, a scale of an image.

    of : observations, joined by ``+``.
    share : sd of the factor, 0.02 for two percent.
    """

    of: str
    share: float

    def __post_init__(self) -> None:
        _check({"share": self.share})

    def systematic(self, name: str, seen: Seen) -> Systematic:
        """One factor."""
        shapes = {each: np.shape(seen.whole(each)[1]) for each in seen.named(self.of)}
        shares = {each: np.full((1, *shape), self.share) for each, shape in shapes.items()}
        return Systematic((name,), {}, shares=shares)


@dataclass(frozen=True)
class Curve:
    """The model is off along a loading curve, and at points near each other alike.

    of : a single number in several load states, as ``reaction:top:x``.
    along : parameter that is known in each state and says where on the curve it is.
    length : over which the error changes, in the unit of ``along``.
    share : sd of the error as a share of what is predicted, known.
    share_scale : instead, the scale of the share's half-normal prior: it is inferred, as
        ``curve_share``, one for all curves.
    sd : sd of the rest of it, in the unit of the data.
    constant : part of the variance that is the same along the whole curve.
    """

    of: str
    along: str
    length: float
    share: float = 0.0
    share_scale: float | None = None
    sd: float = 0.0
    constant: float = 0.0

    def __post_init__(self) -> None:
        _check({"share": self.share, "sd": self.sd})
        if self.share_scale is not None:
            if not self.share_scale > 0.0:
                raise InputError(f"share_scale is {self.share_scale}; it must be above 0")
            if self.share or self.sd:
                raise InputError("share_scale is beside share or sd; give one of them")
        check_curve(self.length, self.constant)

    def systematic(self, name: str, seen: Seen) -> Systematic:
        """As many unknowns as the curve can tell apart."""
        observed = seen.named(self.of)
        for each in observed:
            if np.shape(seen.whole(each)[1]) != ():
                raise InputError(f"of: '{each}' is not a single number, as a force is")
        at = np.array([seen.known(self.along, each) for each in observed])
        size = None if self.share_scale is None else (CURVE_SHARE, self.share_scale)
        alike = curve_modes(at, self.length, constant=self.constant)
        share = self.share if size is None else 1.0
        # Shares, then what is off beside them: unknowns of their own.
        none = np.zeros_like(alike)
        shares, modes = np.vstack([share * alike, none]), np.vstack([none, self.sd * alike])
        used = np.abs(shares + modes).max(axis=1) > 0.0
        names = tuple(f"{name} {k + 1}" for k in range(int(used.sum())))
        each_of = dict(enumerate(observed))
        return Systematic(
            names,
            {each: modes[used, k] for k, each in each_of.items()},
            size,
            {each: shares[used, k] for k, each in each_of.items()},
        )


SHARED_ERRORS: dict[str, type[Any]] = {
    "rigid_motion": RigidMotion,
    "placement": Placement,
    "pins": Pins,
    "gain": Gain,
    "curve": Curve,
}
"""By the word that a file has for it."""


def turned(points: np.ndarray, displacement: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) that carries ``points`` (d, 3) nearest to where they went."""
    there = points + displacement
    U, _, V = np.linalg.svd((there - there.mean(axis=0)).T @ (points - points.mean(axis=0)))
    return U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ V))]) @ V


def shared_error(name: str, description: Mapping[str, Any]) -> SharedError:
    """The error that a run describes under ``name``.

    Raises
    ------
    InputError
        An unknown kind, a key that it does not take or one that it needs, an sd below 0.
    """
    where = f"systematic '{name}'"
    if "kind" not in description:
        raise InputError(f"{where}: key 'kind' is missing; give {', '.join(SHARED_ERRORS)}")
    kind = look_up(SHARED_ERRORS, description["kind"], f"{where}: kind")
    given = {key: value for key, value in description.items() if key != "kind"}
    made: SharedError = schema.read_as(kind, given, where)
    return made


def _check(sizes: Mapping[str, float]) -> None:
    """:class:`InputError` where an sd or a share is below 0."""
    for name, size in sizes.items():
        if size < 0.0:
            raise InputError(f"{name} is {size}; it must be 0 or more")


def with_shared_errors(
    model: Model, data: Mapping[str, Any], descriptions: Mapping[str, Mapping[str, Any]]
) -> tuple[Model, Mapping[str, jax.Array]]:
    """``model`` of the values that are not missing, with these errors, and these values.

    Raises
    ------
    InputError
        As :func:`errors_of_data`.
    """
    # With its errors the model knows how far off data may be; without them it would refuse.
    reduced, present = replace(model, check_scale=False).given(data)
    error = errors_of_data(reduced, descriptions)(present)
    return replace(reduced, check_scale=model.check_scale, error=error), present


def errors_of_data(
    model: Model, descriptions: Mapping[str, Mapping[str, Any]]
) -> Callable[[Mapping[str, Any]], SystematicError]:
    """From data without missing values to the errors that ``model`` has with it.

    Many data sets may be asked for: what does not depend on them is computed once.

    Raises
    ------
    InputError
        An error that does not fit, by its name; and as
        :func:`~calibrate.statistical_model.systematic.with_systematic`.
    """
    errors = {name: shared_error(name, each) for name, each in descriptions.items()}
    information = noise_information(model)

    def made(data: Mapping[str, Any]) -> SystematicError:
        seen = Seen(model, {name: np.asarray(values) for name, values in data.items()})
        found = []
        for name, error in errors.items():
            try:
                found.append(seen.present(error.systematic(name, seen)))
            except InputError as wrong:
                raise InputError(f"systematic '{name}': {wrong}") from wrong
        return systematic_error(model, found, information)

    return made
