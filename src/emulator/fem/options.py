"""Options of the solver."""

from __future__ import annotations

from dataclasses import dataclass

from emulator.core.errors import InputError


@dataclass(frozen=True)
class NewtonOptions:
    """Options of the solver.

    tolerance : largest norm of the residual relative to the internal and external forces, reactions
        included (docs/experiments.md, "The stopping rule of the released solutions").
    round_off : a relative residual below this is accepted where Newton no longer reduces it.
    absolute : residual in mN that is accepted whatever the forces; round-off of the forces at rest
        always is.
    max_iterations : of Newton's method, over all routes and load levels; ramps of loads have their
        own limits (:mod:`emulator.fem.continuation`).
    level_iterations : after which a load level is given up and its increment halved.
    increment : first and largest load increment, as a fraction of the whole. Small increments
        follow the loading path from rest, for bodies with several equilibria (docs/experiments.md,
        "Several equilibria in the soft corner"); another start is then used only if it is already
        the solution.
    min_increment : smallest load increment.
    shrink : least fraction of the smallest ``J`` that a step keeps.
    keep_tangent : after a step that leaves less than this fraction of the residual, its tangent is
        used again; 0 is the full Newton method (docs/experiments.md, "Fewer factorisations from
        rest").
    stress_iterates : begin, when far from equilibrium, with
        :mod:`emulator.fem.formulations.stress_iterates` where the scene allows it (see ``applies``
        there); never with load increments (docs/experiments.md, "Stresses as iterates: the
        ventricle from rest in five factorisations").
    """

    tolerance: float = 1e-11
    round_off: float = 1e-8
    absolute: float = 0.0
    max_iterations: int = 300
    level_iterations: int = 40
    increment: float = 1.0
    min_increment: float = 1.0 / 256.0
    shrink: float = 0.2
    keep_tangent: float = 0.1
    stress_iterates: bool = True

    def __post_init__(self) -> None:
        if not self.min_increment <= self.increment <= 1.0:
            raise InputError(
                f"load increment {self.increment:g}: give {self.min_increment:g} (the least) to 1"
            )

    @classmethod
    def load_steps(cls, steps: int) -> NewtonOptions:
        """Options that follow the loading path in ``steps`` equal increments, or smaller ones."""
        if steps < 1:
            raise InputError(f"{steps} load steps; give 1 or more")
        return cls(increment=1.0 / steps, max_iterations=max(cls.max_iterations, 20 * steps))
