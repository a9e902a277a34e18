r"""Stresses of gripped specimens: FEM of the piece, and polynomials of theta fitted to it.

Each test is followed state by state. Where stretches were measured between marks, the grips'
displacements q are unknown, and Newton's method finds those at which the marks' gradient M is the
measured one,

.. math:: q \leftarrow q + \left(\frac{dM}{dq}\right)^{-1} (H - M(u(q))), \qquad
          \frac{dM}{dq} = M\!\left(\frac{\partial u}{\partial q}\right),

with FEM's own derivatives of the equilibrium. What grips add to the homogeneous stress
:math:`P_h` of a state is told as a share of its Frobenius norm,

.. math:: P = P_h + |P_h|\, s(\theta) ,

which varies little along a test and over the box of theta: a few states of a test are solved, and a
few dozen theta teach polynomials of theta that add it to the stresses of any map.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import PchipInterpolator

from emulator.core.display import counting
from emulator.core.errors import InputError, SolverError
from emulator.fem.campaign import at_once, in_order
from emulator.fem.campaign.designs import sobol
from emulator.fem.simulator import Simulator
from emulator.specimens.grips import GripStresses
from emulator.specimens.homogeneous import Homogeneous, homogeneous, homogeneous_stresses
from emulator.specimens.piece import Piece, pieces
from emulator.specimens.specimen import Specimen
from emulator.specimens.states import States
from emulator.surrogates.polynomial import Samples, fit, legendre, terms
from emulator.surrogates.protocol import fingerprint_of

RUNS = 60
"""Default number of theta from which it is learned what grips do."""

_STEPS = 8  # of the grips' displacements in a state
_CLOSE = 1e-5  # difference between measured and computed stretch that is none
_MOST_STATES = 6  # of a test that are solved
_HELD_OUT = 5  # each fifth theta is not fitted to
_PLENTY = 1.5  # theta for each term of a polynomial
_HIGHEST = 4  # degree of a polynomial
_FEWEST = 10  # theta


def added(P: jax.Array, shares: jax.Array) -> jax.Array:
    """Return stresses P (m, 3, 3) plus ``shares`` (m, 3, 3) of their norms, which grips add."""
    square = jnp.sum(P**2, axis=(1, 2), keepdims=True)
    loaded = square > 0.0  # at rest the root has no derivative
    return P + jnp.where(loaded, jnp.sqrt(jnp.where(loaded, square, 1.0)), 0.0) * shares


def gripped_stresses(scene: Specimen, P: jax.Array, theta: jax.Array) -> jax.Array:
    """Return homogeneous stresses (m, 3, 3) plus those of the scene's grips, if learned."""
    if scene.grips is None or (learned := scene.grips.learned) is None:
        return P
    if learned.of != of_grips(scene):
        raise InputError(
            f"scene '{scene.name}': what was learned is of another specimen, range or grips; train "
            "it again"
        )
    shares = np.nan_to_num(learned.shares)
    return added(P, jnp.tensordot(legendre(scene.to_unit(theta), learned.degrees), shares, 1))


@dataclass(frozen=True, eq=False)
class GrippedState:
    """A piece in a state of a test.

    q : what the grips have moved by, as shares of the piece's lengths, (q,).
    u : the displacement (n, 3) mm.
    slopes : the derivatives of u in q, (q, n, 3); ``None`` at rest.
    """

    q: np.ndarray
    u: jax.Array
    slopes: np.ndarray | None


@dataclass(frozen=True, eq=False)
class GrippedSpecimen:
    """FEM of a specimen between its grips.

    specimen : the specimen, with grips.

    :class:`InputError` for a specimen without grips, or as of
    :func:`~emulator.specimens.piece.pieces`.
    """

    specimen: Specimen

    def __post_init__(self) -> None:
        if self.specimen.grips is None:
            raise InputError(f"scene '{self.specimen.name}' says nothing of grips")
        self.simulators  # noqa: B018 - refuses directions that a piece cannot have

    @property
    def states(self) -> States:
        """The states of the specimen."""
        return self.specimen.states

    @cached_property
    def pieces(self) -> Mapping[str, Piece]:
        """The piece of each test, by the test's name."""
        return pieces(self.specimen)

    @cached_property
    def simulators(self) -> Mapping[Piece, Simulator]:
        """FEM of each piece."""
        return {piece: Simulator(piece.scene) for piece in dict.fromkeys(self.pieces.values())}

    @cached_property
    def homogeneous(self) -> Homogeneous:
        """The homogeneous states without grips."""
        return homogeneous(self.specimen)

    @property
    def workers(self) -> int:
        """The number of theta that are solved at once."""
        return min(at_once(simulator) for simulator in self.simulators.values())

    def stresses(self, theta: jax.Array, rows: np.ndarray | None = None) -> np.ndarray:
        """Return the first Piola-Kirchhoff stresses (m, 3, 3) in kPa of the states at ``theta``.

        Components that act on no grip are NaN.

        rows : the states (k,) that are solved; by default all. Others are NaN.

        :class:`SolverError` where FEM does not converge in one of the states.
        """
        theta = jnp.asarray(theta, dtype=float)
        P = np.full(self.states.gradients.shape, np.nan)
        for name, test in self.states.protocols.items():
            selection = test if rows is None else test[np.isin(test, rows)]
            for row, at in zip(selection, self.path(name, theta, selection), strict=True):
                P[row] = self._force(self.pieces[name], theta, at)
        return P

    def shares(self, theta: jax.Array) -> np.ndarray:
        """Return the stress that grips add to each state, (m, 3, 3), over its homogeneous norm.

        At most six states of a test are solved; those between them are interpolated.

        :class:`SolverError` where FEM does not converge.
        """
        theta = jnp.asarray(theta, dtype=float)
        u = self.homogeneous.solve(theta).require_converged("the specimen").displacement
        even = np.asarray(homogeneous_stresses(self.specimen, u, theta)[1])
        sizes = np.sqrt(np.sum(even**2, axis=(1, 2)))
        paths, protocols = self.states.paths, self.states.protocols
        solved = {name: _spread(rows, sizes, paths) for name, rows in protocols.items()}
        P = self.stresses(theta, np.concatenate(list(solved.values())))
        shares = np.full_like(P, np.nan)
        for name, rows in protocols.items():
            known = solved[name]
            excess = (P[known] - even[known]) / sizes[known, None, None]
            acting = self.pieces[name].acting
            if len(known) > 1:
                excess = PchipInterpolator(paths[known], np.where(acting, excess, 0.0))(paths[rows])
            shares[rows] = np.where(acting, excess, np.nan)
        return shares

    def path(
        self, test: str, theta: jax.Array, rows: np.ndarray | None = None
    ) -> list[GrippedState]:
        """Return the states of a test, one after the other, at ``theta`` (p,).

        rows : states of the test (k,) that are solved, ascending; by default all.

        :class:`SolverError` where FEM does not converge in one of them.
        """
        piece, selection = self.pieces[test], self.states.protocols[test] if rows is None else rows
        at = GrippedState(np.zeros(len(piece.components)), self.simulators[piece].rest, None)
        path = []
        for H in self.states.gradients[selection]:
            target = H[piece.rows, piece.columns]
            if target.any():
                at = self._follow(piece, jnp.asarray(theta, dtype=float), target, at)
            path.append(at)
        return path

    def _force(self, piece: Piece, theta: jax.Array, at: GrippedState) -> np.ndarray:
        """Return the stress (3, 3) in kPa that acts on the grips."""
        P, theta_q = np.full((3, 3), np.nan), jnp.concatenate([theta, jnp.asarray(at.q)])
        for face, upper in piece.upper.items():
            force = np.asarray(self.simulators[piece].reaction(upper, at.u, theta_q))
            P[:, face] = np.where(piece.acting[:, face], force / piece.area(face), np.nan)
        return P

    def _follow(
        self, piece: Piece, theta: jax.Array, target: np.ndarray, at: GrippedState
    ) -> GrippedState:
        """Return the state in which grips or marks have moved by ``target`` (q,), after ``at``."""
        simulator, by_marks = self.simulators[piece], piece.grips.marks is not None
        for _ in range(_STEPS):
            step, start = target - at.q, simulator.rest
            if at.slopes is not None:
                if by_marks:
                    missing = target - piece.between_marks(np.asarray(at.u))
                    if np.abs(missing).max() < _CLOSE:
                        return at
                    columns = [piece.between_marks(slope) for slope in at.slopes]
                    step = np.linalg.solve(np.array(columns).T, missing)
                start = at.u + jnp.tensordot(jnp.asarray(step), jnp.asarray(at.slopes), 1)
            theta_q = jnp.concatenate([theta, jnp.asarray(at.q + step)])
            solution = simulator.solve(theta_q, start).require_converged("the gripped specimen")
            slopes = simulator.sensitivities(solution.displacement, theta_q)[len(theta) :]
            at = GrippedState(at.q + step, solution.displacement, np.asarray(slopes))
            if not by_marks:
                return at
        raise SolverError("the gripped specimen: its grips do not come to the measured stretch")


def _spread(rows: np.ndarray, sizes: np.ndarray, paths: np.ndarray) -> np.ndarray:
    """Return the states of a test that are solved: the ends of its loaded part, and some between.

    Of states between which the test was held still, it is the first.

    sizes : the norms (m,) of all homogeneous stresses.
    paths : the way (m,) of each state from the beginning of its test.
    """
    loaded = rows[sizes[rows] > 1e-6 * sizes.max()]
    loaded = loaded[np.unique(paths[loaded], return_index=True)[1]]
    at = np.linspace(0, len(loaded) - 1, min(len(loaded), _MOST_STATES)).round().astype(int)
    return loaded[at]


def learn_grips(
    specimen: Specimen, runs: int = RUNS, *, seed: int = 0, progress: bool = False
) -> GripStresses:
    """Learn the stresses that grips add to a specimen's, from FEM at ``runs`` theta of its box.

    Theta at which FEM fails are left out.

    Raises
    ------
    InputError
        As of :class:`GrippedSpecimen`; fewer than 10 runs, or fewer at which FEM converged.
    """
    if runs < _FEWEST:
        raise InputError(f"{runs} FEM runs; give {_FEWEST} or more")
    gripped = GrippedSpecimen(specimen)
    thetas = sobol(specimen, runs, seed)

    def solve(theta: jax.Array) -> np.ndarray | None:
        try:
            return gripped.shares(theta)
        except SolverError:
            return None

    with counting(total=runs, desc="gripped FEM", disable=not progress, unit="run") as bar:
        outcomes = []
        for shares in in_order(solve, iter(thetas), gripped.workers):
            outcomes.append(shares)
            bar.update()
    rows = np.array([k for k, shares in enumerate(outcomes) if shares is not None], dtype=int)
    if len(rows) < _FEWEST:
        raise InputError(
            f"FEM of the gripped piece converged at {len(rows)} of {runs} theta; narrow the ranges"
        )
    shares = np.stack([values for values in outcomes if values is not None])
    flat = np.nan_to_num(shares.reshape(len(rows), -1))
    samples = Samples(np.asarray(specimen.to_unit(thetas[rows])), flat, np.zeros(len(rows)))
    degree, error = _best(samples, ~np.isnan(shares[0]).ravel())
    fitted = fit(samples, degree, 0.0)
    coefficients = fitted.coefficients.reshape(-1, *shares.shape[1:])
    return GripStresses(
        fitted.degrees,
        np.where(np.isnan(shares[0]), np.nan, coefficients),
        error,
        of_grips(specimen),
    )


def _best(samples: Samples, acting: np.ndarray) -> tuple[int, float]:
    """Return the degree that predicts held-out samples best, and its root mean square error."""
    parameters, count = samples.position.shape[1], len(samples.position)
    held_out = np.arange(count) % _HELD_OUT == 0
    known, new = samples.take(~held_out), samples.take(held_out)
    errors = {}
    for degree in range(_HIGHEST + 1):
        if degree and terms(parameters, degree) * _PLENTY > len(known.position):
            break
        missed = (fit(known, degree, 0.0).at(new.position) - new.fields)[:, acting]
        errors[degree] = float(np.sqrt(np.mean(missed**2)))
    return min(errors.items(), key=lambda item: item[1])


def of_grips(specimen: Specimen) -> str:
    """Return a short hash of a specimen and how it was held."""
    grips = specimen.grips
    assert grips is not None
    apart = ("size", "learned")  # an array of its own, and what the hash is kept with
    words = tuple(getattr(grips, field.name) for field in fields(grips) if field.name not in apart)
    free = replace(specimen, grips=None)
    return fingerprint_of("grips", free.fingerprint, repr(words), np.asarray(grips.size))
