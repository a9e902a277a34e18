"""The effects that may be left out of a scene, and the scene without each of them.

Laws, loads and supports say which of their effects can be left out, and what stands in its place.
The scene adds the order of the elements, mean or patch dilatation, and regions of different
stiffness. A simpler scene takes some of the scene's parameters and has some of its nodes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from emulator.core.errors import InputError
from emulator.geometry.fibres import of_elements
from emulator.geometry.refinement import corner_parents, to_linear
from emulator.scenes.forward_problem import directions_read
from emulator.scenes.scene import Scene
from emulator.scenes.tissue import effective_angles, stiffness_quantities


class Effect(NamedTuple):
    """The scene ``without`` an effect, and the ``remedy``: the change of a file that removes it."""

    without: Scene
    remedy: str


def effects_of(scene: Scene) -> dict[str, Effect]:
    """Return the effects that ``scene`` can do without, by name."""
    effects: dict[str, Effect] = {}
    for name, changes, remedy in _changes(scene):
        without = _change(scene, **changes)
        if without is not None:
            effects.setdefault(name, Effect(without, remedy))
    return effects


def leave_out(scene: Scene, names: Iterable[str]) -> Scene:
    """Return ``scene`` without the effects ``names``, and without effects that depend on them.

    Raises
    ------
    InputError
        An effect that ``scene`` does not have, or cannot do without.
    """
    simpler = scene
    for name in names:
        if _remove(scene, name) is None:
            raise InputError(
                f"scene '{scene.name}' has no effect '{name}' that it can do without; it has "
                f"{', '.join(effects_of(scene)) or 'none'}"
            )
        simpler = _remove(simpler, name) or simpler
    return simpler


def _remove(scene: Scene, effect: str) -> Scene | None:
    """Return ``scene`` without the effect; None where it has none of that name, or needs it."""
    changes = next((changes for name, changes, _ in _changes(scene) if name == effect), None)
    return None if changes is None else _change(scene, **changes)


@dataclass(frozen=True, eq=False)
class Onto:
    """The projection of theta onto a simpler scene, and of its displacement back.

    The simpler scene has the nodes of the whole scene, or the corners of its quadratic elements;
    between two corners the displacement is their mean, as on linear elements.

    whole : the scene with all effects.
    simpler : the scene without some of them.
    """

    whole: Scene
    simpler: Scene

    def theta(self, theta: jax.Array) -> jax.Array:
        """Return theta (..., q) of the simpler scene from theta (..., p) of the whole scene."""
        names = self.whole.parameter_names
        entries = [names.index(name) for name in self.simpler.parameter_names]
        return jnp.asarray(theta)[..., jnp.asarray(entries)]

    def field(self, u: jax.Array) -> jax.Array:
        """Return the displacement (n, 3) at all nodes of the whole scene from the simpler one."""
        if self.whole.mesh.order == self.simpler.mesh.order:
            return u
        return jnp.mean(u[corner_parents(self.whole.mesh)], axis=1)


def _changes(scene: Scene) -> Iterator[tuple[str, dict[str, Any], str]]:
    """Yield each effect's name, the fields of the scene without it, and the change of its file."""
    for name, law in scene.law.simpler:
        yield name, {"law": law}, f'law = "{law.name}"'
    for field, table in (("loads", "[[loads]]"), ("supports", "[[supports]]")):
        parts = getattr(scene, field)
        for k, part in enumerate(parts):
            if part.simpler is None:
                continue
            name, other = part.simpler
            remaining = [p for p in (*parts[:k], other, *parts[k + 1 :]) if p is not None]
            remedy = f"leave out '{part.kind}' in {table}"
            if other is not None:
                remedy = f"in {table} write '{other.kind}' for '{part.kind}'"
            yield name, {field: tuple(remaining)}, remedy
    if scene.regions is not None:
        yield "regional stiffness", {"regions": None}, "leave out regions"
    if scene.stiffness_modes is not None:
        yield "a field of stiffness", {"stiffness_modes": None}, "leave out stiffness_modes"
    if scene.dilatation != "pointwise":
        name = f"{scene.dilatation} dilatation"
        yield name, {"dilatation": "pointwise"}, 'dilatation = "pointwise"'
    if scene.mesh.order == 2:
        linear = {"mesh": to_linear(scene.mesh), "dilatation": "pointwise"}
        for kind in ("fibres", "sheets"):
            if getattr(scene, kind) is not None:
                linear[kind] = of_elements(getattr(scene, kind))
        yield "quadratic elements", linear, "order = 1, and no dilatation"


def _change(scene: Scene, **changes: Any) -> Scene | None:
    """Return ``scene`` with other fields; None where it would be at rest or invalid.

    Directions, rotations, parameters and constants that nothing reads any more are left out.
    """
    law, loads, supports, regions, modes = (
        changes.get(field, getattr(scene, field))
        for field in ("law", "loads", "supports", "regions", "stiffness_modes")
    )
    if not loads and not scene.prescribed.moves:
        return None
    for kind, reader in directions_read(law, loads).items():
        changes[kind] = None if reader is None else changes.get(kind, getattr(scene, kind))
    changes["angles"] = effective_angles(scene.angles, changes["fibres"], changes["sheets"])
    names_read = {*law.parameters, *(q.name for q in stiffness_quantities(regions, modes))}
    for part in (*loads, *supports, *changes["angles"]):
        names_read |= {quantity.name for quantity in part.quantities}
    try:
        return replace(
            scene,
            **changes,
            parameters=tuple(p for p in scene.parameters if p.name in names_read),
            constants={name: v for name, v in scene.constants.items() if name in names_read},
            origin={},
        )
    except InputError:
        return None
