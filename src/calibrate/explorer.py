"""A local page with a slider for every parameter: the body deforms live, by the cached emulator."""

from __future__ import annotations

import json
import threading
from collections.abc import Mapping
from functools import cached_property
from importlib.resources import files
from typing import Any
from urllib.parse import parse_qsl, urlsplit

import jax
import jax.numpy as jnp
import numpy as np
from plotly.offline import get_plotlyjs

from calibrate.local_server import Handler, Server, listen
from calibrate.measurements.klotz import klotz_of
from calibrate.measurements.volume import PressureVolume, pressure_volume
from emulator.accuracy.estimate import ErrorBar
from emulator.core.errors import InputError
from emulator.fem import Simulator, Status
from emulator.geometry.facets import Cavity, surface_mesh
from emulator.scenes.loads import KPA_PER_MMHG
from emulator.scenes.scene import cavity_sets
from emulator.surrogates.emulator import Emulator


class Explorer:
    """An emulator's answers about its scene, by the position of theta in the unit box.

    Calls may come from several threads; FEM and the error bar take one at a time.
    """

    def __init__(self, emulator: Emulator) -> None:
        self.scene = emulator.scene
        self._forward = emulator.cache()
        self._nodes, self._triangles = surface_mesh(self.scene.mesh.surface)
        self._cavities = {name: Cavity(self.scene.mesh, name) for name in cavity_sets(self.scene)}
        self._slow = threading.Lock()

    @cached_property
    def page(self) -> bytes:
        """The page with its drawing library and the description of the scene."""
        text = files("calibrate").joinpath("explorer.html").read_text(encoding="utf-8")
        about = json.dumps(self.about()).replace("</", "<\\/")
        return text.replace("{{plotly}}", get_plotlyjs()).replace("{{about}}", about).encode()

    def about(self) -> dict[str, Any]:
        """Describe the scene: parameters, the surface at rest, cavities."""
        return {
            "name": self.scene.name,
            "parameters": [
                {"name": p.name, "unit": p.unit, "low": p.low, "high": p.high, "scale": p.scale}
                for p in self.scene.parameters
            ],
            "nodes": np.round(self.scene.mesh.nodes[self._nodes], 4).tolist(),
            "triangles": self._triangles.tolist(),
            "cavities": list(self._cavities),
            "kpa_per_mmhg": KPA_PER_MMHG,
            "pressure": None if self._curve is None else self._curve.parameter.name,
        }

    def theta(self, position: Mapping[str, str]) -> jax.Array:
        """Return theta (p,) from a position in [0, 1] of every parameter, and of nothing else."""
        names = self.scene.parameter_names
        unknown = set(position) - set(names)
        if unknown:
            raise InputError(f"'{min(unknown)}' is no parameter; there are {', '.join(names)}")
        values = []
        for name in names:
            try:
                value = float(position[name])
            except KeyError:
                raise InputError(f"no position for '{name}'") from None
            except ValueError:
                raise InputError(f"{name} = '{position[name]}' is no number") from None
            if not 0.0 <= value <= 1.0:
                raise InputError(f"{name} = {value:g} is not between 0 and 1")
            values.append(value)
        return self.scene.from_unit(jnp.array(values))

    def at(self, position: Mapping[str, str]) -> bytes:
        """Return the surface's displacement, then the cavities' volumes in mL, as float32."""
        u, volumes = self._fast(self.theta(position))
        both = np.concatenate([np.asarray(u, "<f4").ravel(), np.asarray(volumes, "<f4")])
        return both.tobytes()

    def curve(self, position: Mapping[str, str]) -> dict[str, Any]:
        """Return the volume of a cavity over the range of its pressure, other parameters fixed.

        ``klotz`` is the relation through the volume at ``position`` (:class:`Klotz`), or None.
        """
        if self._curve is None:
            raise InputError(f"scene '{self.scene.name}' has no cavity whose pressure varies")
        theta, pressures = self.theta(position), self._curve.pressures
        volumes = np.asarray(self._volumes(theta))
        pressure = float(theta[self.scene.parameter_names.index(self._curve.parameter.name)])
        klotz = klotz_of(self.scene, np.interp(pressure, pressures, volumes), pressure)
        return {
            "pressure": pressures.tolist(),
            "volume": volumes.tolist(),
            "rest": self._curve.rest,
            "klotz": None if klotz is None else np.asarray(klotz.volume(pressures)).tolist(),
        }

    def error(self, position: Mapping[str, str]) -> dict[str, Any]:
        """Return the guard's verdict, and the estimated error in mm and mL."""
        theta = self.theta(position)
        with self._slow:
            estimate = self._bar.of_field(self._forward(theta), theta)
        result: dict[str, Any] = {
            "trusted": bool(estimate.guard.trusted),
            "guard": estimate.guard.sentence(self.scene),
            "valid": bool(estimate.valid),
        }
        if result["valid"]:
            result |= {"median_mm": float(estimate.median), "max_mm": float(estimate.max)}
            for name, cavity in self._cavities.items():
                result[f"{name} mL"] = float(estimate.of(lambda u, c=cavity: c(u[c.nodes])))
        return result

    def compare(self, position: Mapping[str, str]) -> dict[str, Any]:
        """Solve FEM at the theta of the request, and return the emulator's distance from it."""
        theta = self.theta(position)
        with self._slow:
            solution = self._simulator.solve(theta, self._forward(theta))
        status = Status(int(solution.status))
        if status is not Status.CONVERGED:
            return {"status": status.text}
        error = np.linalg.norm(self._forward(theta) - solution.displacement, axis=1)
        displacement = np.linalg.norm(solution.displacement, axis=1)
        volumes = {n: float(c(solution.displacement[c.nodes])) for n, c in self._cavities.items()}
        return {
            "status": status.text,
            "median_mm": float(np.median(error)),
            "max_mm": float(error.max()),
            "moved_mm": float(displacement.max()),
            "volumes": volumes,
        }

    @cached_property
    def _simulator(self) -> Simulator:
        return Simulator(self.scene)

    @cached_property
    def _bar(self) -> Any:
        return ErrorBar(self._forward, self._simulator)

    @cached_property
    def _fast(self) -> Any:
        def both(theta: jax.Array) -> tuple[jax.Array, jax.Array]:
            u = self._forward(theta)
            volumes = [cavity(u[cavity.nodes]) for cavity in self._cavities.values()]
            return u[self._nodes], jnp.stack(volumes) if volumes else jnp.zeros(0)

        return jax.jit(both)

    @cached_property
    def _curve(self) -> PressureVolume | None:
        return pressure_volume(self._forward)

    @cached_property
    def _volumes(self) -> Any:
        assert self._curve is not None, "asked for a curve only"
        return jax.jit(self._curve.volumes)


class _PageHandler(Handler):
    """Answers one request to the explorer, the server's subject."""

    def do_GET(self) -> None:
        """Answer with the page, or with the data that the page asks for."""
        address, explorer = urlsplit(self.path), self.server.subject
        name = address.path.removeprefix("/")
        if self.is_foreign():
            self.send(403, b"this page is for this machine only\n", "text/plain")
        elif not name:
            self.send(200, explorer.page, "text/html; charset=utf-8")
        elif name not in ("at", "curve", "error", "compare"):
            self.send(404, b"there are /, /at, /curve, /error and /compare\n", "text/plain")
        else:
            try:
                content = getattr(explorer, name)(dict(parse_qsl(address.query)))
            except InputError as fault:
                self.send(400, f"{fault}\n".encode(), "text/plain; charset=utf-8")
                return
            plain = isinstance(content, bytes)
            self.send(200, content, "application/octet-stream" if plain else "application/json")


def serve(explorer: Explorer, port: int = 0) -> Server:
    """Return a server on the loopback address, ready for ``serve_forever``; port 0 is any."""
    return listen(_PageHandler, explorer, port)
