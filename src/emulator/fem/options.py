"""Controls of the solver."""

from __future__ import annotations

from dataclasses import dataclass

from emulator.errors import InputError


@dataclass(frozen=True)
class NewtonOptions:
    """Controls of the solver.

    tolerance : residual relative to the internal forces, reactions included.
    round_off : a residual below this that Newton no longer reduces has met round-off, and will do.
    absolute : residual in mN that is small enough whatever the forces; 0 asks for the others.
    max_iterations : over all load levels.
    level_iterations : after which a load level is given up and its increment halved.
    increment : first and largest load increment, as a fraction of the whole. Small ones follow the
        loading path, which matters to a body that has several equilibria.
    min_increment : smallest load increment.
    shrink : least fraction of the present smallest ``J`` that a step may leave.
    keep_tangent : a step that leaves less than this fraction of the residual has its tangent used
        again; 0 is Newton's method to the letter.
    stress_iterates : begin, when far from equilibrium, with :mod:`emulator.fem.mip` where it can be
        done; never inside ``jit``, with a factorisation of your choice, or in load increments.
    """

    tolerance: float = 1e-11
    round_off: float = 1e-8
    absolute: float = 0.0
    max_iterations: int = 200
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
