"""The effects of a scene that it can do without, and the scene without each.

Laws, loads and supports say which effect of theirs can be left out, and what stands in its place;
the rest is the scene's: the elements' order, their mean or patch dilatation, and regions of
different stiffness. A simpler scene takes some of the scene's parameters and lives on some of its
nodes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp

from emulator.core.errors import InputError
from emulator.geometry.fibres import of_elements
from emulator.geometry.refinement import corner_parents, to_linear
from emulator.scenes.fibre_angles import that_turn
from emulator.scenes.owners import directions_read
from emulator.scenes.scene import Scene


@dataclass(frozen=True, eq=False)
class Effect:
    """An effect that a scene can do without.

    name : of the effect. without : the scene without it. remedy : what to write in a scene file.
    """

    name: str
    without: Scene
    remedy: str


def effects_of(scene: Scene) -> dict[str, Effect]:
    """The effects that ``scene`` can do without, by name."""
    found: dict[str, Effect] = {}
    for name, changes, remedy in _changes(scene):
        without = _changed(scene, **changes)
        if without is not None:
            found.setdefault(name, Effect(name, without, remedy))
    return found


def leave_out(scene: Scene, names: Iterable[str]) -> Scene:
    """``scene`` without the effects of these names; one that went with another is left out too.

    Raises
    ------
    InputError
        An effect that ``scene`` does not have, or cannot do without.
    """
    names = tuple(names)
    for name in names:
        if _without(scene, name) is None:
            raise InputError(
                f"scene '{scene.name}' has no effect '{name}' that it can do without; it has "
                f"{', '.join(effects_of(scene)) or 'none'}"
            )
    for name in names:
        scene = _without(scene, name) or scene
    return scene


def _without(scene: Scene, wanted: str) -> Scene | None:
    """``scene`` without the effect; None where it has none of that name, or needs it."""
    for name, changes, _ in _changes(scene):
        if name == wanted:
            return _changed(scene, **changes)
    return None


@dataclass(frozen=True, eq=False)
class Onto:
    """Takes theta to a simpler scene, and its displacement back to the nodes of the whole one.

    The simpler scene has the whole one's nodes, or the corners of its quadratic elements; between
    two corners the displacement is their mean, as on linear elements.
    """

    whole: Scene
    simpler: Scene

    def theta(self, theta: jax.Array) -> jax.Array:
        """Theta (..., q) of the simpler scene from the whole one's (..., p)."""
        names = self.whole.parameter_names
        kept = [names.index(name) for name in self.simpler.parameter_names]
        return jnp.asarray(theta)[..., jnp.asarray(kept)]

    def field(self, u: jax.Array) -> jax.Array:
        """Displacement (n, 3) at all nodes of the whole scene from the simpler one's."""
        if self.whole.mesh.order == self.simpler.mesh.order:
            return u
        return jnp.mean(u[corner_parents(self.whole.mesh)], axis=1)


_Change = tuple[str, dict[str, Any], str]


def _changes(scene: Scene) -> Iterator[_Change]:
    """Name of each effect, the scene's fields without it, and what to write in its file."""
    for name, law in scene.law.simpler:
        yield name, {"law": law}, f'law = "{law.name}"'
    for field, table in (("loads", "[[loads]]"), ("supports", "[[supports]]")):
        parts = getattr(scene, field)
        for k, part in enumerate(parts):
            if part.simpler is None:
                continue
            name, other = part.simpler
            kept = (*parts[:k], *((other,) if other is not None else ()), *parts[k + 1 :])
            remedy = f"in {table} write '{other.kind}' for '{part.kind}'" if other else ""
            yield name, {field: kept}, remedy or f"leave out '{part.kind}' in {table}"
    if scene.regions is not None:
        yield "regional stiffness", {"regions": None}, "leave out regions"
    if scene.dilatation != "pointwise":
        name = f"{scene.dilatation} dilatation"
        yield name, {"dilatation": "pointwise"}, 'dilatation = "pointwise"'
    if scene.mesh.order == 2:
        linear = {"mesh": to_linear(scene.mesh), "dilatation": "pointwise"}
        for kind in ("fibres", "sheets"):
            if getattr(scene, kind) is not None:
                linear[kind] = of_elements(getattr(scene, kind))
        yield "quadratic elements", linear, "order = 1, and no dilatation"


def _changed(scene: Scene, **changes: Any) -> Scene | None:
    """``scene`` with other fields and what they need; None where nothing would be left to do."""
    law = changes.get("law", scene.law)
    loads = changes.get("loads", scene.loads)
    regions = changes.get("regions", scene.regions)
    if not loads and not scene.prescribed.moves:
        return None
    for kind, reader in directions_read(law, loads).items():
        changes.setdefault(kind, getattr(scene, kind))
        changes[kind] = None if reader is None else changes[kind]
    changes["angles"] = that_turn(scene.angles, changes["fibres"], changes["sheets"])
    parts = (*loads, *changes.get("supports", scene.supports))
    takers = set(law.parameters) | {q.name for part in parts for q in part.quantities}
    takers |= {q.name for angles in changes["angles"] for q in angles.quantities}
    if regions is not None:
        takers |= {name for name in scene.quantities if name.startswith("stiffness_")}
    try:
        return replace(
            scene,
            **changes,
            parameters=tuple(p for p in scene.parameters if p.name in takers),
            constants={name: v for name, v in scene.constants.items() if name in takers},
            origin={},
        )
    except InputError:
        return None
