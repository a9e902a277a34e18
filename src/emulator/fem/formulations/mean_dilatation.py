r"""Newton's method for saddle points: mean dilatation, and inverse motion.

With mean dilatation, each block's volume ratio and pressure are unknowns besides the displacement;
they are eliminated block by block (:mod:`emulator.fem.condensation`). In inverse motion
(:mod:`emulator.fem.inverse_motion`) the tangent is not symmetric, with or without such blocks.

The solution is then no minimum, so no energy can judge a step, and the residual is dominated by the
stiff volumes. Deuflhard's natural monotonicity test does: the simplified Newton step (with the old
tangent) after a fraction of the step must be shorter than the step,

.. math::
    \left| K(x)^{-1} r(x + \alpha \Delta x) \right|
    \le \left(1 - \frac{\alpha}{4}\right) |\Delta x|

in mm (P. Deuflhard, Newton Methods for Nonlinear Problems, 2004, section 3.3). The tangent is
factorised already, so the test costs one evaluation of the forces and one back-substitution
(docs/experiments.md, "Mean dilatation from far away: what judges a step").
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from emulator.fem import condensation, inverse_motion
from emulator.fem.assembly import System
from emulator.fem.compiled import compiled
from emulator.fem.formulations.displacement import Displacement, Linearised, MonotonicityTest
from emulator.fem.solution import NewtonState


class MeanDilatation(Displacement):
    """The formulation with volume ratios and pressures."""

    blocks: ClassVar[Any] = condensation
    """The module that linearises the blocks and eliminates their unknowns."""

    @staticmethod
    def serves(system: System) -> bool:
        """Return whether elements, or patches of them, share a volume ratio."""
        return system.scene.dilatation != "pointwise"

    @property
    def programs(self) -> dict[Any, Callable[..., Any]]:
        """The compiled functions, which the system keeps."""
        return self.system.programs

    @compiled
    def begin(self, u: jax.Array, theta: jax.Array) -> Any:
        """Return the volumes and pressures that follow from the displacement ``u`` (n, 3) mm."""
        return self.blocks.consistent(self.system.scene, u, theta)

    def linearise(self, state: NewtonState, theta: jax.Array) -> Linearised:
        """Return the equations at ``state``, volumes and pressures eliminated."""
        return self._linearise(state.u, state.auxiliary, theta, state.load)

    @compiled
    def _linearise(
        self, u: jax.Array, volumes: Any, theta: jax.Array, load: jax.Array
    ) -> Linearised:
        system = self.system
        condensed = self.blocks.linearise(system.scene, u, volumes, theta)
        residual = system.residual_of(condensed.force, u, theta, load)
        tangent, solvable, offset_force = system.equations(condensed.tangent, u, theta, load, load)
        return Linearised(tangent, solvable, residual, offset_force, condensed.couplings)

    def monotonicity_test(
        self, state: NewtonState, theta: jax.Array, equations: Linearised, step: jax.Array
    ) -> MonotonicityTest:
        """Return the test of natural monotonicity of fractions of ``step`` (n, 3) mm."""
        return partial(self._test, (state.u, state.auxiliary, state.load, theta), equations, step)

    @compiled
    def _test(self, at: Any, equations: Linearised, step: jax.Array, fraction: jax.Array) -> Any:
        system, couplings, valid = self.system, equations.couplings, jnp.array(True)
        u, volumes, load, theta = at
        v, remainder = u + fraction * step, 1.0 - fraction
        if couplings is None:
            force = system.residual(v, theta, load)
        else:
            trial = couplings.advance(volumes, step[system.scene.blocks.connectivity], fraction)
            residuals = self.blocks.residuals(system.scene, v, trial, theta)
            force = system.residual_of(couplings.eliminated(residuals), v, theta, load)
            valid = jnp.min(trial.change) > -1.0
        rhs = -(force + remainder * equations.offset_force)
        simplified = system.extend(system.solve(equations.tangent, rhs))
        simplified = simplified + remainder * jnp.where(system.scene.held, step, 0.0)
        return valid & (
            jnp.linalg.norm(simplified) <= (1.0 - 0.25 * fraction) * jnp.linalg.norm(step)
        )

    @compiled
    def advance(self, auxiliary: Any, couplings: Any, step: jax.Array, fraction: jax.Array) -> Any:
        """Return volumes and pressures after ``fraction`` of the full ``step`` (n, 3) mm."""
        if couplings is None:
            return auxiliary
        return couplings.advance(auxiliary, step[self.system.scene.blocks.connectivity], fraction)


class Inverse(MeanDilatation):
    """The formulation of inverse motion, from the loaded shape to the stress-free one.

    Without blocks that share a volume ratio its auxiliary unknowns are empty, and tangents are kept
    as in :class:`.displacement.Displacement`.
    """

    blocks: ClassVar[Any] = inverse_motion

    @staticmethod
    def serves(system: System) -> bool:
        """Return whether the equations are those of inverse motion."""
        return system.inverse

    def linearise(self, state: NewtonState, theta: jax.Array) -> Linearised:
        """Return the equations at ``state``, or with the tangent it keeps."""
        if state.displacement_only:
            return self._renewed_or_kept(state, theta, state.load)
        return super().linearise(state, theta)
