"""Controls of the solver."""

from __future__ import annotations

from dataclasses import dataclass

from emulator.errors import InputError


@dataclass(frozen=True)
class NewtonOptions:
    """Controls of the solver.

    In docs/experiments.md: "The stopping rule of the released solutions" for the tolerances, "Fewer
    factorisations from rest" for ``keep_tangent``.

    tolerance : residual relative to the internal forces, reactions included.
    round_off : a relative residual below this is accepted where Newton no longer reduces it.
    absolute : residual in mN that is accepted whatever the forces at work; round-off of the forces
        at rest always is.
    max_iterations : over all routes and load levels.
    level_iterations : after which a load level is given up and its increment halved.
    increment : first and largest load increment, as a fraction of the whole. Small ones follow the
        loading path from rest, which matters to a body that has several equilibria; a start other
        than rest is then used only if it is the solution already.
    min_increment : smallest load increment.
    shrink : least fraction of the present smallest ``J`` that a step may leave.
    keep_tangent : a step that leaves less than this fraction of the residual has its tangent used
        again; 0 is Newton's method to the letter.
    stress_iterates : begin, when far from equilibrium, with :mod:`emulator.fem.mip` where the scene
        allows it (see :func:`emulator.fem.mip.applies`); never in load increments.
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
