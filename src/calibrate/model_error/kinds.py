r"""The kinds of systematic error that an experiment file may name, each a table of a few numbers.

A kind says what is unknown of a measurement in the terms of the person who measured. From the
observations and their data it makes a :class:`~calibrate.model_error.systematic.Systematic`. The
share of a gain or a curve is one of the prediction. All other modes are fixed numbers: where one
depends on the deformed body (where a marker was seen), the data says it, and it is off by the noise
of a datum, which at an angle of one degree is a sixtieth of that noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from calibrate.measurements import Observations
from calibrate.measurements.points import DisplacementPoints
from calibrate.model_error.systematic import (
    Systematic,
    curve_modes,
    placement,
    rigid_motion,
    spatial_modes,
)
from calibrate.noise.protocol import Scale, check_positive
from calibrate.state_names import split
from emulator.core import schema
from emulator.core.errors import InputError, look_up

Vector = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Measurement:
    """The observations and data that systematic errors disturb.

    observe : the observations, without missing values.
    data : their data by name.
    theta : the entry of theta for each parameter, by load state: the known value, or the name of an
        unknown.
    """

    observe: Observations
    data: Mapping[str, np.ndarray]
    theta: Mapping[str, Mapping[str, str | float]]

    def named(self, words: str) -> list[str]:
        """Return the observations that words joined by ``+`` name, in one load state or in all."""
        return list(self.observe.expand(dict.fromkeys(words.split("+"), True), "of"))

    def shape(self, name: str) -> tuple[int, ...]:
        """Return the shape of an observation's data, missing values included."""
        return self.observe.parts[name].shape

    def points(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return points at rest and their displacements, 0 where missing, both (d, 3) mm."""
        part = self.observe.parts[name]
        if not isinstance(part, DisplacementPoints):
            raise InputError(f"of: '{name}' is no displacement of points ({part.quantity})")
        return part.points, np.nan_to_num(self.observe.filled(name, np.asarray(self.data[name])))

    def known(self, parameter: str, name: str) -> float:
        """Return the known value of ``parameter`` in the load state of observation ``name``."""
        entries = self.theta[split(name)[1]]
        if parameter not in entries:
            raise InputError(
                f"along: '{parameter}' is no parameter; there are {', '.join(entries)}"
            )
        value = entries[parameter]
        if isinstance(value, str):
            raise InputError(f"along: '{value}' is not known; give its value as known")
        return value

    def present(self, error: Systematic) -> Systematic:
        """Return ``error`` in the entries that are not missing."""

        def reduced(modes: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
            entries = self.observe.entries
            return {
                name: rows.reshape(len(rows), -1)[:, entries[name]] if name in entries else rows
                for name, rows in modes.items()
            }

        return replace(error, modes=reduced(error.modes), shares=reduced(error.shares))


@dataclass(frozen=True)
class RigidMotion:
    """A shift and a turn of all points together, as of a camera or a clamp that moved.

    of : the observations of displacements, joined by ``+``.
    shift : the sd along x, y and z, mm; one for all, or three.
    turn : the sd about x, y and z, degrees; one for all, or three.
    about : the point that only shifts, mm; by default the mean of all points.
    at : the positions at which points move: ``loaded``, where they were seen, or ``rest``.
    """

    of: str
    shift: float | Vector = 0.0
    turn: float | Vector = 0.0
    about: Vector | None = None
    at: Literal["loaded", "rest"] = "loaded"

    def systematic(self, name: str, measurement: Measurement) -> Systematic:
        """Return three shifts and three turns."""
        positions = {}
        for observation in measurement.named(self.of):
            points, displacement = measurement.points(observation)
            positions[observation] = points + displacement if self.at == "loaded" else points
        return rigid_motion(name, positions, self.shift, self.turn, self.about)


@dataclass(frozen=True)
class Placement:
    """An offset of each number, which is the same in all the observations.

    of : the observations, all of the same shape, joined by ``+``.
    sd : the sd of each offset, in the unit of the data.
    rows : the indices of the points that have an offset, from 0; by default all.
    """

    of: str
    sd: float
    rows: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        _check_not_negative(sd=self.sd)

    def systematic(self, name: str, measurement: Measurement) -> Systematic:
        """Return one offset for each number."""
        names = measurement.named(self.of)
        shapes = {measurement.shape(observation) for observation in names}
        if len(shapes) > 1:
            raise InputError(f"of: {', '.join(names)} have different numbers of points")
        sd = np.zeros(shapes.pop())
        points = np.atleast_1d(sd)
        for row in range(len(points)) if self.rows is None else self.rows:
            if not 0 <= row < len(points):
                raise InputError(f"rows: there is no point {row}; they are counted from 0")
            points[row] = self.sd
        every = placement(name, names, sd)
        used = np.flatnonzero(np.ravel(sd))
        modes = {observation: modes[used] for observation, modes in every.modes.items()}
        return Systematic(tuple(every.names[k] for k in used), modes)


@dataclass(frozen=True)
class Pins:
    r"""One offset of all markers in the body's frame from the positions in the file.

    Where their surface has turned by R, as their data says, an offset d moves a marker by
    :math:`(R - I)\,d` more.

    of : the observations of three markers or more, joined by ``+``.
    sd : the sd of the offset along each axis, mm.
    """

    of: str
    sd: float

    def __post_init__(self) -> None:
        _check_not_negative(sd=self.sd)

    def systematic(self, name: str, measurement: Measurement) -> Systematic:
        """Return one offset along each axis."""
        modes = {}
        for observation in measurement.named(self.of):
            points, displacement = measurement.points(observation)
            if len(points) < 3 or np.linalg.matrix_rank(points - points.mean(axis=0)) < 2:
                raise InputError(f"of: '{observation}' has no three markers, not on one line")
            rows = self.sd * (rotation_of(points, displacement) - np.eye(3)).T
            modes[observation] = np.repeat(rows[:, None], len(points), axis=1)
        return Systematic(tuple(f"{name} {axis}" for axis in "xyz"), modes)


@dataclass(frozen=True)
class Gain:
    """One factor of all the data, as of a load cell or of the scale of an image.

    of : the observations, joined by ``+``.
    share : the sd of the factor, 0.02 for two percent.
    """

    of: str
    share: float

    def __post_init__(self) -> None:
        _check_not_negative(share=self.share)

    def systematic(self, name: str, measurement: Measurement) -> Systematic:
        """Return one factor."""
        names = measurement.named(self.of)
        shares = {
            observation: np.full((1, *measurement.shape(observation)), self.share)
            for observation in names
        }
        return Systematic((name,), {}, shares=shares)


@dataclass(frozen=True)
class Curve:
    """An error of the model that varies smoothly along a loading curve.

    of : the observation of one number in several load states, as ``reaction:top:x``.
    along : the parameter that is known in each state and is the curve's abscissa.
    length : the correlation length of the error, in the unit of ``along``.
    share : the known sd of the error as a share of the prediction.
    share_scale : the scale of the half-normal prior of a share that is inferred instead, as
        ``curve_share``, one for all curves.
    sd : the sd of a further error, in the unit of the data.
    constant : the part of the variance that is the same along the whole curve.
    """

    of: str
    along: str
    length: float
    share: float = 0.0
    share_scale: float | None = None
    sd: float = 0.0
    constant: float = 0.0

    def __post_init__(self) -> None:
        _check_not_negative(share=self.share, sd=self.sd)
        if self.share_scale is not None:
            check_positive("share_scale", self.share_scale)
            if self.share or self.sd:
                raise InputError("share_scale is beside share or sd; give one of them")
        check_positive("length", self.length)
        if not 0.0 <= self.constant <= 1.0:
            raise InputError(f"constant is {self.constant}; it is a part, 0 to 1")

    def systematic(self, name: str, measurement: Measurement) -> Systematic:
        """Return as many unknowns as the curve can tell apart."""
        observations = measurement.named(self.of)
        for observation in observations:
            if measurement.shape(observation) != ():
                raise InputError(f"of: '{observation}' is not a single number, as a force is")
        amounts = np.array(
            [measurement.known(self.along, observation) for observation in observations]
        )
        size = None if self.share_scale is None else ("curve_share", self.share_scale)
        unit = curve_modes(amounts, self.length, constant=self.constant)
        share = self.share if size is None else 1.0
        # The share of the prediction and the further error have unknowns of their own.
        zeros = np.zeros_like(unit)
        shares, modes = np.vstack([share * unit, zeros]), np.vstack([zeros, self.sd * unit])
        used = np.abs(shares + modes).max(axis=1) > 0.0
        names = tuple(f"{name} {k + 1}" for k in range(int(used.sum())))
        return Systematic(
            names,
            {observation: modes[used, k] for k, observation in enumerate(observations)},
            size,
            {observation: shares[used, k] for k, observation in enumerate(observations)},
        )


@dataclass(frozen=True)
class FieldError:
    r"""An error of displacements that is smooth in space and grows along the loading.

    It is what image correlation and the model miss of a full field. Of a component at the point X,
    in the state of amount a,

    .. math:: e(X, a) = \sigma\, \frac{a}{a_\text{max}}\, f(X, a), \qquad
              \operatorname{cov}(f, f') = k(|X - X'| / \ell)\, k(|a - a'| / \ell_a),

    with Matérn's kernel k of smoothness 3/2.

    of : the observations of displacements, of the same points, joined by ``+``.
    along : the parameter that is known in each state and says how far the loading has come.
    length : the correlation length in space, mm.
    along_length : the correlation length along the loading, in the unit of ``along``; by default
        the error is in proportion to the amount, one field for all states.
    sd : the sd at the largest amount, mm; or
    sd_scale : the scale of the half-normal prior of one that is inferred, as ``field_sd``.
    share : the share of the error's variance that modes of few points may leave out.
    """

    of: str
    along: str
    length: float
    along_length: float | None = None
    sd: float | None = None
    sd_scale: float | None = None
    share: float = 0.01

    def __post_init__(self) -> None:
        Scale("field_sd", ("sd", "sd_scale"), self.sd, self.sd_scale)  # refuses what cannot be
        check_positive("length", self.length)
        if self.along_length is not None:
            check_positive("along_length", self.along_length)
        if not 0.0 <= self.share < 1.0:
            raise InputError(f"share is {self.share}; it is a part of the variance, 0 to below 1")

    def systematic(self, name: str, measurement: Measurement) -> Systematic:
        """Return as many unknowns as carry all but a share of the variance."""
        observations = measurement.named(self.of)
        first = observations[0]
        points, components = measurement.points(first)[0], measurement.shape(first)[1]
        for observation in observations:
            if not np.array_equal(measurement.points(observation)[0], points):
                raise InputError(f"of: '{observation}' and '{first}' are of other points")
        amounts = np.array(
            [measurement.known(self.along, observation) for observation in observations]
        )
        if not np.abs(amounts).max() > 0.0:
            raise InputError(f"along: '{self.along}' is 0 in every state")
        along = np.ones((1, len(amounts)))
        if self.along_length is not None:
            along = curve_modes(amounts, self.along_length)
        grown = along * amounts / np.abs(amounts).max()
        in_space = spatial_modes(points, self.length)
        # All products of 600 points and 20 states would fill a gigabyte: only those that are kept.
        variances = np.outer(np.sum(in_space**2, axis=1), np.sum(grown**2, axis=1)).ravel()
        order = np.argsort(-variances)
        carried = np.cumsum(variances[order]) / variances.sum()
        used = order[: int(np.searchsorted(carried, 1.0 - self.share)) + 1]
        space, time = np.divmod(used, len(grown))
        kept = grown[time][:, :, None] * in_space[space][:, None, :]
        size = None if self.sd_scale is None else ("field_sd", self.sd_scale)
        rows = np.einsum("rsd,ci->rcsdi", kept * (self.sd or 1.0), np.eye(components))
        rows = rows.reshape(-1, len(amounts), len(points), components)
        names = tuple(f"{name} {k + 1}" for k in range(len(rows)))
        return Systematic(names, {n: rows[:, k] for k, n in enumerate(observations)}, size)


@dataclass(frozen=True)
class Modes:
    r"""Errors of which the covariance is known, :math:`C = V^T V`, as of an emulator's numbers.

    of : the observations of d numbers together, joined by ``+``, missing ones included.
    modes : the rows of V, (s, d) in the units of the data: the change of all these numbers, one
        observation after the other, for one sd of each of s independent amounts.
    """

    of: str
    modes: tuple[tuple[float, ...], ...]

    def systematic(self, name: str, measurement: Measurement) -> Systematic:
        """Return an unknown for each mode."""
        shapes = {o: measurement.shape(o) for o in measurement.named(self.of)}
        sizes = [int(np.prod(shape)) for shape in shapes.values()]
        for row in self.modes:
            if len(row) != sum(sizes):
                raise InputError(f"modes: a row has {len(row)} numbers; {self.of} has {sum(sizes)}")
        if not self.modes or not np.isfinite(self.modes).all():
            raise InputError("modes: give one or more, of finite numbers")
        parts = np.split(np.array(self.modes), np.cumsum(sizes)[:-1], axis=1)
        modes = {o: V.reshape(-1, *shapes[o]) for o, V in zip(shapes, parts, strict=True)}
        return Systematic(tuple(f"{name} {k + 1}" for k in range(len(self.modes))), modes)


Kind = RigidMotion | Placement | Pins | Gain | Curve | FieldError | Modes

SYSTEMATIC_ERRORS: dict[str, type[Kind]] = {
    "rigid_motion": RigidMotion,
    "placement": Placement,
    "pins": Pins,
    "gain": Gain,
    "curve": Curve,
    "field": FieldError,
    "modes": Modes,
}
"""Kinds of systematic error by their word in a file."""


def rotation_of(points: np.ndarray, displacement: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) that fits the displacement of ``points`` (d, 3) best."""
    deformed = points + displacement
    U, _, V = np.linalg.svd((deformed - deformed.mean(axis=0)).T @ (points - points.mean(axis=0)))
    return U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ V))]) @ V


def read_systematic(name: str, description: Mapping[str, Any]) -> Kind:
    """Return the error that a run describes under ``name``.

    :class:`InputError` for an unknown kind, an unknown or missing key, or a negative standard
    deviation.
    """
    where = f"systematic '{name}'"
    if "kind" not in description:
        raise InputError(f"{where}: key 'kind' is missing; give {', '.join(SYSTEMATIC_ERRORS)}")
    kind = look_up(SYSTEMATIC_ERRORS, description["kind"], f"{where}: kind")
    entries = {key: value for key, value in description.items() if key != "kind"}
    return schema.read_as(kind, entries, where)


def _check_not_negative(**sizes: float) -> None:
    for name, size in sizes.items():
        if size < 0.0:
            raise InputError(f"{name} is {size}; it must be 0 or more")
