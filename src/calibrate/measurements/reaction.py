"""The force of a support: of a plate that shears a cube, of a clamp."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import jax

from calibrate.measurements.observation import Scalar, derive
from emulator.core.errors import InputError
from emulator.core.units import IN_MN
from emulator.fem.reactions import SupportForce
from emulator.scenes.scene import Scene
from emulator.surrogates.protocol import ForwardMap

_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True, eq=False)
class Reaction(Scalar):
    """Force of a support on the body along a direction, one number in N.

    scene : the scene, with a support there.
    support : the name of the support's node set or facet set.
    direction : ``x``, ``y``, ``z``, or three components joined by commas, made unit length.
    force : the force in mN as a function of the displacement near the support, derived.

    Raises
    ------
    InputError
        No support of that name, or one that does not act along the direction.
    """

    scene: Scene
    support: str
    direction: str
    force: SupportForce = field(init=False)

    kind = "reaction"
    hint = ", such as reaction:top:x"
    quantity = "force"
    unit = "N"
    arguments = ("support", "direction")
    positive = False

    def __post_init__(self) -> None:
        force = SupportForce(self.scene, self.support, _direction(self.direction))
        derive(self, force=force, nodes=force.nodes)

    def evaluate(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the force (...) in N."""
        return self.force(displacement, theta) / IN_MN["N"]

    def through(self, forward: ForwardMap) -> Callable[[jax.Array], jax.Array] | None:
        """Return the force () in N by the work of the whole body, of an emulator of the scene."""
        by_work = getattr(forward, "support_force", None)
        force = None if by_work is None else by_work(self.force)
        return None if force is None else lambda theta: force(theta) / IN_MN["N"]


def _direction(text: str) -> tuple[float, float, float]:
    if text in _AXES:
        return _AXES[text]
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(
            f"direction '{text}' of a reaction; give x, y, z or three numbers like 0.6,0,0.8"
        ) from None
    return x, y, z
