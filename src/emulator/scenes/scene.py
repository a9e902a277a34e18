"""A scene: everything that is simulated, frozen."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from emulator.errors import InputError
from emulator.geometry.discretisation import Discretisation, discretise
from emulator.geometry.mesh import Mesh, frozen_array
from emulator.mechanics.laws import Law
from emulator.mechanics.quantity import Quantity
from emulator.scenes.loads.dead import Gravity, Load
from emulator.scenes.loads.pressure import CavityPressure, require_held_rim
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.regions import checked_regions, region_quantities
from emulator.scenes.supports.dirichlet import Support, free_motions, prescribe
from emulator.scenes.supports.elastic import ElasticSupport


@dataclass(frozen=True, eq=False)
class Scene:
    """Geometry, law, loads, supports and parameters of one problem.

    Frozen, arrays included: an energy traced from it means the same for ever.

    Parameters
    ----------
    name : for people.
    mesh : geometry in mm.
    law : hyperelastic law.
    parameters : entries of theta, in order.
    loads : external loads; none is a body deformed by its supports alone.
    supports : where the displacement is known, and where springs resist it.
    constants : parameters of the law and the loads that do not vary.
    fibres : (m, 3) unit fibre direction of each element, for laws that ask for it.
    origin : how a built-in scene was made, so that a file can make it again.
    dilatation : ``pointwise``, or ``mean`` to take the volume change of each element as one, which
        keeps quadratic elements from locking when the material is nearly incompressible.
    sheets : (m, 3) unit sheet direction of each element, across its fibre, for laws that ask for
        it.
    regions : (m,) whole number of the region each element lies in. Region 3 takes a parameter or a
        constant ``stiffness_3``, by which the law's energy there is multiplied, its volumetric part
        excepted; see :mod:`emulator.scenes.regions`.
    """

    name: str
    mesh: Mesh
    law: Law
    parameters: tuple[Parameter, ...]
    loads: tuple[Load, ...] = ()
    supports: tuple[Support | ElasticSupport, ...] = ()
    constants: Mapping[str, float] = field(default_factory=dict)
    fibres: np.ndarray | None = None
    origin: Mapping[str, Any] = field(default_factory=dict)
    dilatation: Literal["pointwise", "mean"] = "pointwise"
    sheets: np.ndarray | None = None
    regions: np.ndarray | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "constants", MappingProxyType(dict(self.constants)))
        object.__setattr__(self, "origin", MappingProxyType(dict(self.origin)))
        self._check_regions()
        self._check_names()
        self._check_quantities()
        self._check_directions()
        self._check_dilatation()
        if not self.parameters:
            raise InputError(f"scene '{self.name}': no parameter varies, nothing to calibrate")
        self._check_supports()
        self._check_loads()

    def _check_regions(self) -> None:
        if self.regions is not None:
            try:
                labels = checked_regions(self.regions, len(self.mesh.elements), self.law)
            except InputError as error:
                raise InputError(f"scene '{self.name}': {error}") from error
            object.__setattr__(self, "regions", labels)

    def _check_names(self) -> None:
        given = [*self.parameter_names, *self.constants]
        takers = self._takers
        for name in given:
            if name not in takers:
                raise InputError(
                    f"scene '{self.name}': parameter '{name}' is not one of law "
                    f"'{self.law.name}' and its loads: {', '.join(takers)}"
                )
            if given.count(name) > 1:
                raise InputError(f"scene '{self.name}': parameter '{name}' is given twice")
        for name, (_, owner) in takers.items():
            if name not in given:
                raise InputError(f"scene '{self.name}': {owner} needs '{name}'")

    def _check_quantities(self) -> None:
        """Units and values of parameters and constants against what law and loads take."""
        faults = [self._takers[name][0].value_fault(v) for name, v in self.constants.items()]
        for parameter in self.parameters:
            quantity, owner = self._takers[parameter.name]
            faults.append(quantity.unit_fault(parameter.unit, owner))
            faults.append(quantity.range_fault(parameter.low, parameter.high))
        for fault in faults:
            if fault:
                raise InputError(f"scene '{self.name}': {fault}")

    def _check_directions(self) -> None:
        for kind, asked in (("fibres", self.law.fibres), ("sheets", self.law.sheets)):
            given = getattr(self, kind)
            if given is None:
                if asked:
                    raise InputError(f"scene '{self.name}': law '{self.law.name}' needs {kind}")
                continue
            if not asked:
                raise InputError(f"scene '{self.name}': law '{self.law.name}' takes no {kind}")
            vectors = frozen_array(given)
            object.__setattr__(self, kind, vectors)
            if vectors.shape != (len(self.mesh.elements), 3):
                raise InputError(
                    f"scene '{self.name}': {kind} have shape {vectors.shape}; "
                    f"expected ({len(self.mesh.elements)}, 3)"
                )
            if not np.allclose(np.linalg.norm(vectors, axis=1), 1.0, atol=1e-6):
                raise InputError(f"scene '{self.name}': {kind} are not unit vectors")
        if self.fibres is not None and self.sheets is not None:
            along = np.abs(np.einsum("mi,mi->m", self.fibres, self.sheets)).max()
            if not along < 1e-6:
                raise InputError(
                    f"scene '{self.name}': sheets are not across the fibres (cosine {along:.2g})"
                )

    def _check_dilatation(self) -> None:
        if self.dilatation not in ("pointwise", "mean"):
            raise InputError(
                f"scene '{self.name}': dilatation '{self.dilatation}'; use pointwise or mean"
            )
        if self.dilatation == "mean" and self.mesh.order == 1:
            raise InputError(
                f"scene '{self.name}': mean dilatation on linear tetrahedra changes nothing, "
                "they have one point each; make the mesh quadratic"
            )

    def _check_supports(self) -> None:
        if not self.supports:
            raise InputError(f"scene '{self.name}': no support, the body could move freely")
        nodes, axes = np.nonzero(self.held)
        springs = [support.resisted(self) for support in self.elastic_supports]
        points = np.concatenate([self.mesh.nodes[nodes], *(place for place, _ in springs)])
        directions = np.concatenate([np.eye(3)[axes], *(along for _, along in springs)])
        free = free_motions(points, directions)
        if free:
            raise InputError(
                f"scene '{self.name}': its supports leave {free} of the 6 rigid motions free, "
                "the body could move or turn; hold more nodes or components"
            )

    def _check_loads(self) -> None:
        for load in self.loads:
            if not isinstance(load, Gravity):
                self.mesh.facet_set(load.facet_set)
            if isinstance(load, CavityPressure):
                require_held_rim(self, load.facet_set)

    @property
    def _takers(self) -> dict[str, tuple[Quantity, str]]:
        """Every parameter law, loads and regions take, by name, with who takes it."""
        takers = {q.name: (q, f"law '{self.law.name}'") for q in self.law.quantities}
        if self.regions is not None:
            takers |= {q.name: (q, "a region") for q in region_quantities(self.regions)}
        for load in self.loads:
            for quantity in load.quantities:
                takers.setdefault(quantity.name, (quantity, f"load {type(load).__name__}"))
        return takers

    # ---- parameters -------------------------------------------------------------------------
    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the entries of theta, in order."""
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def centre(self) -> jax.Array:
        """Theta in the middle of its box, on each parameter's scale, shape (p,)."""
        return self.from_unit(jnp.full(len(self.parameters), 0.5))

    def theta(self, **values: float) -> jax.Array:
        """Theta from named values in the parameters' units, shape (p,).

        Raises
        ------
        InputError
            Unknown, missing or out-of-range value.
        """
        for name in values:
            if name not in self.parameter_names:
                raise InputError(
                    f"scene '{self.name}' has no parameter '{name}'; "
                    f"it has {', '.join(self.parameter_names)}"
                )
        missing = [name for name in self.parameter_names if name not in values]
        if missing:
            raise InputError(f"scene '{self.name}': no value for parameter '{missing[0]}'")
        theta = jnp.array([float(values[name]) for name in self.parameter_names])
        self.check_theta(theta)
        return theta

    def check_theta(self, theta: jax.Array) -> None:
        """Raise :class:`InputError` unless every row of ``theta`` (..., p) is inside the box."""
        rows = np.atleast_2d(np.asarray(theta))
        if rows.shape[-1] != len(self.parameters):
            raise InputError(
                f"scene '{self.name}': theta has {rows.shape[-1]} values; "
                f"expected {len(self.parameters)}: {', '.join(self.parameter_names)}"
            )
        for k, parameter in enumerate(self.parameters):
            slack = 1e-9 * (parameter.high - parameter.low)
            inside = (rows[:, k] >= parameter.low - slack) & (rows[:, k] <= parameter.high + slack)
            if not inside.all():
                value = rows[np.flatnonzero(~inside)[0], k]
                raise InputError(
                    f"parameter '{parameter.name}' is {value:g} {parameter.unit}; scene "
                    f"'{self.name}' covers {parameter.low:g} to {parameter.high:g}"
                )

    def to_unit(self, theta: jax.Array) -> jax.Array:
        """Theta (..., p) as positions in its box, 0 to 1 inside."""
        columns = [p.to_unit(theta[..., k]) for k, p in enumerate(self.parameters)]
        return jnp.stack(columns, axis=-1)

    def from_unit(self, position: jax.Array) -> jax.Array:
        """Inverse of :meth:`to_unit`."""
        columns = [p.from_unit(position[..., k]) for k, p in enumerate(self.parameters)]
        return jnp.stack(columns, axis=-1)

    def resolve(self, theta: jax.Array) -> dict[str, jax.Array]:
        """Every parameter of law, loads and regions by name, from theta (p,) and the constants."""
        values: dict[str, Any] = dict(self.constants)
        values.update({name: theta[k] for k, name in enumerate(self.parameter_names)})
        return values

    # ---- discretisation and supports ----------------------------------------------------------
    @cached_property
    def discretisation(self) -> Discretisation:
        """Shape functions and quadrature of the mesh."""
        return discretise(self.mesh)

    @cached_property
    def directions(self) -> np.ndarray | None:
        """What a law may know of each element: fibre (m, 3), or fibre and sheet (m, 2, 3)."""
        if self.fibres is None or self.sheets is None:
            return self.fibres
        return frozen_array(np.stack([self.fibres, self.sheets], axis=1))

    @property
    def elastic_supports(self) -> tuple[ElasticSupport, ...]:
        """Those of the supports that are springs."""
        return tuple(s for s in self.supports if isinstance(s, ElasticSupport))

    @cached_property
    def prescribed(self) -> tuple[np.ndarray, np.ndarray]:
        """``(held, values)``: where the displacement is known, (n, 3) bool, and it, (n, 3) mm."""
        return prescribe(self.mesh, [s for s in self.supports if isinstance(s, Support)])

    @property
    def held(self) -> np.ndarray:
        """Where the displacement is known, (n, 3) bool."""
        return self.prescribed[0]

    @property
    def held_displacement(self) -> np.ndarray:
        """Known displacement in mm, zero elsewhere, (n, 3)."""
        return self.prescribed[1]

    # ---- identity ------------------------------------------------------------------------------
    @cached_property
    def fingerprint(self) -> str:
        """Short hash of all that shapes the solution; equal scenes have equal fingerprints."""
        digest = hashlib.sha256()
        # Adding 0.0 turns the -0.0 that rounding leaves into 0.0.
        digest.update((np.round(self.mesh.nodes, 9) + 0.0).tobytes())
        digest.update(np.sort(self.mesh.elements, axis=1).tobytes())
        digest.update(self.held.tobytes())
        digest.update((np.round(self.held_displacement, 9) + 0.0).tobytes())
        if self.fibres is not None:
            digest.update((np.round(self.fibres, 6) + 0.0).tobytes())
        if self.sheets is not None:
            digest.update((np.round(self.sheets, 6) + 0.0).tobytes())
        if self.regions is not None:
            digest.update(self.regions.astype(np.int64).tobytes())
        surfaces = {getattr(part, "facet_set", "") for part in (*self.loads, *self.supports)}
        for name in sorted(surfaces - {""}):
            digest.update(np.sort(np.sort(self.mesh.facet_set(name), axis=1), axis=0).tobytes())
        description: dict[str, Any] = {
            "law": self.law.name,
            "constants": {name: float(self.constants[name]) for name in sorted(self.constants)},
            "parameters": [[p.name, float(p.low), float(p.high), p.scale] for p in self.parameters],
            "loads": [load.describe() for load in self.loads],
        }
        if self.elastic_supports:
            description["springs"] = [support.describe() for support in self.elastic_supports]
        if self.dilatation != "pointwise":
            description["dilatation"] = self.dilatation
        digest.update(json.dumps(description, sort_keys=True).encode())
        return digest.hexdigest()[:16]
