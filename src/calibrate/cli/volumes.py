"""Cavity volumes at rest and loaded, as commands tell them."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import jax

    from emulator.accuracy.estimate import ErrorEstimate
    from emulator.scenes.scene import Scene

Volumes = dict[str, dict[str, float | None]]


def volumes(scene: Scene, u: jax.Array, estimate: ErrorEstimate | None = None) -> Volumes:
    """Of each cavity in mL: at rest, at ``u`` (n, 3) mm, and its estimated error, if any."""
    import jax

    from emulator.geometry.facets import Cavity
    from emulator.scenes.cavities import cavity_sets

    found: Volumes = {}
    for name in cavity_sets(scene):
        cavity = Cavity(scene.mesh, name)

        def volume(u: jax.Array, cavity: Cavity = cavity) -> jax.Array:
            return cavity(u[cavity.nodes])

        error = None if estimate is None or not estimate.valid else float(estimate.of(volume))
        loaded = float(jax.jit(volume)(u))
        found[name] = {"rest_ml": float(cavity.rest), "volume_ml": loaded, "error_ml": error}
    return found


def volume_lines(found: Volumes) -> list[str]:
    """A line for each cavity."""
    lines = []
    for name, cavity in found.items():
        error = "" if cavity["error_ml"] is None else f", error {cavity['error_ml']:+.2g} mL"
        rest, loaded = cavity["rest_ml"], cavity["volume_ml"]
        lines.append(f"cavity '{name}': {loaded:.6g} mL, at rest {rest:.6g} mL{error}")
    return lines
