"""The identity of a scene: everything its solutions depend on, in a canonical form.

The form does not depend on the order of tetrahedra and facets, nor on the order of theta or its
ranges. Two scenes have equal solutions if their identities agree; a scene's *fingerprint*
hashes its identity together with theta's order and box. Emulators and posteriors store the
fingerprint and refuse a scene whose fingerprint differs.

Every field of a scene is in its identity, and every field of a specimen. Those of ``_FORMS`` have a
canonical form, those of ``_LEFT_OUT`` change no solution, and any other field, also one that is
added later, is described entry by entry (:func:`described`) where it differs from its default.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from typing import Any

import numpy as np

from emulator.geometry.discretisation import quadrature_points
from emulator.geometry.mesh import Mesh
from emulator.mechanics.laws.law import law_identity
from emulator.scenes.forward_problem import ForwardProblem
from emulator.scenes.scene_data import SceneData

# Decimals that the fingerprint hashes, 1 nm of lengths in mm, so that round-off, which differs
# between machines, hardly ever decides on one; some files store directions in single precision.
_DIGITS = 6
_TOLERANCE = 1e-6  # lengths relative to the body's size, and directions, agree within this
_HASH_LENGTH = 16  # hexadecimal digits

_FORMS = frozenset(
    {
        "mesh", "law", "parameters", "loads", "supports", "constants", "fibres", "sheets",
        "regions", "angles", "stiffness_modes", "dilatation",
    }
)  # fmt: skip
_LEFT_OUT = frozenset(
    {
        "name",  # only in messages
        "origin",  # how the scene was made, which a file need not know
        "fibre_rule",  # its directions on this mesh are in "fibres"
        "table",  # the text that a specimen's states were read from
        "homogeneous",  # what a user says of a specimen's states, which are that anyway
    }
)


@dataclass(frozen=True, eq=False)
class Identity:
    """Everything the solutions of a scene depend on, apart from theta.

    lengths : the arrays in mm by name: nodes, prescribed displacements.
    directions : the unit vectors by name: fibres, sheets and their rotations, if there are any.
    indices : the arrays of whole numbers by name: tetrahedra, prescribed components, regions, facet
        sets under a load or a support.
    description : the law, constants, loads, springs, the names of the parameters, and fields
        without a form of their own, plain JSON.
    """

    lengths: Mapping[str, np.ndarray]
    directions: Mapping[str, np.ndarray]
    indices: Mapping[str, np.ndarray]
    description: Mapping[str, Any]

    def agrees(self, other: Identity) -> bool:
        """Return whether both scenes have equal solutions; the order of nodes must match."""
        size = float(np.linalg.norm(np.ptp(self.lengths["nodes"], axis=0)))
        return (
            _close(self.lengths, other.lengths, _TOLERANCE * size)
            and _close(self.directions, other.directions, _TOLERANCE)
            and _close(self.indices, other.indices, 0.0)
            and self.description == other.description
        )


def identity_of(scene: SceneData) -> Identity:
    """Return the identity of ``scene``, its elements and facets in a fixed order."""
    mesh, (held, fixed, per_unit) = scene.mesh, scene.prescribed
    elements = np.sort(mesh.elements, axis=1)
    order = np.lexsort(elements.T)
    facet_sets = sorted({n for part in (*scene.loads, *scene.supports) for n in part.facet_sets})
    indices = {"elements": elements[order], "held": held}
    indices |= {f"facets {name}": _as_set(mesh.facet_set(name)) for name in facet_sets}
    if scene.regions is not None:
        indices["regions"] = scene.regions[order]
    directions = {"fibres": scene.fibres, "sheets": scene.sheets}
    for k, rotation in enumerate(scene.angles):
        directions[f"axis of rotation {k}"] = rotation.axis
        for name, share in rotation.shares.items():
            directions[f"share of {name} in rotation {k}"] = share[..., None]
    directions["stiffness modes"] = scene.stiffness_modes
    springs = [support.to_json() for support in scene.supports]
    description = {
        "law": law_identity(scene.law),
        "constants": {name: float(value) for name, value in scene.constants.items()},
        "parameters": sorted(parameter.name for parameter in scene.parameters),
        "loads": sorted(json.dumps(load.to_json()) for load in scene.loads),
        "springs": sorted(json.dumps(spring) for spring in springs if spring is not None),
        "dilatation": scene.dilatation,
    }
    description |= described_fields(scene, _FORMS)
    displacements = {f"displacement per unit of {name}": d for name, d in per_unit.items()}
    return Identity(
        lengths={"nodes": mesh.nodes, "displacement": fixed, **displacements},
        directions={
            name: _points_in_order(mesh, values)[order]
            for name, values in directions.items()
            if values is not None
        },
        indices=indices,
        description=description,
    )


def described_fields(problem: Any, forms: Collection[str]) -> dict[str, Any]:
    """Return the description of each field but those in ``forms`` and those of no consequence.

    A field at its default is left out, which leaves the fingerprints of saved files.

    problem : the scene or the specimen, a dataclass.
    """
    description = {}
    for field in fields(problem):
        if field.name not in _LEFT_OUT.union(forms):
            value = described(getattr(problem, field.name))
            if value != described(_default(field)):
                description[field.name] = value
    return description


def fingerprint(problem: ForwardProblem, identity: Identity) -> str:
    """Return a short hash of the problem's identity and of the order and the box of theta."""
    content = [_text(dict(identity.description))]
    # Adding 0.0 turns the -0.0 that rounding leaves into 0.0.
    for name, values in sorted({**identity.lengths, **identity.directions}.items()):
        content += [name.encode(), (np.round(values, _DIGITS) + 0.0).tobytes()]
    for name, values in sorted(identity.indices.items()):
        content += [name.encode(), values.astype(np.int64).tobytes()]
    content.append(
        _text([[p.name, float(p.low), float(p.high), p.scale] for p in problem.parameters])
    )
    digest = hashlib.sha256()
    for part in content:
        # Lengths mark where each part ends, so that two lists of parts never hash alike.
        digest.update(len(part).to_bytes(8, "little") + part)
    return digest.hexdigest()[:_HASH_LENGTH]


def described(value: Any) -> Any:
    """Return ``value`` as plain JSON that differs where any entry of it does.

    Dataclasses are described by class and by field, arrays by shape and a hash of their rounded
    values; numbers are floats, and -0.0 is 0.0.
    """
    if is_dataclass(value) and not isinstance(value, type):
        entries = {field.name: described(getattr(value, field.name)) for field in fields(value)}
        return {"class": type(value).__name__, **entries}
    if isinstance(value, Mapping):
        return {str(name): described(entry) for name, entry in value.items()}
    if isinstance(value, tuple | list):
        return [described(entry) for entry in value]
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, int | float | np.number):
        return float(value) + 0.0
    array = np.asarray(value)
    if array.dtype.kind not in "biuf":
        raise TypeError(f"an identity cannot describe a {type(value).__name__}")
    rounded = np.round(array.astype(float), _DIGITS) + 0.0
    return [list(array.shape), hashlib.sha256(rounded.tobytes()).hexdigest()[:_HASH_LENGTH]]


def _default(field: Field[Any]) -> Any:
    """Return the default of a field of a scene; None where it has none."""
    if field.default_factory is not MISSING:
        return field.default_factory()
    return None if field.default is MISSING else field.default


def _close(a: Mapping[str, np.ndarray], b: Mapping[str, np.ndarray], tolerance: float) -> bool:
    return a.keys() == b.keys() and all(
        a[name].shape == b[name].shape and np.allclose(a[name], b[name], rtol=0.0, atol=tolerance)
        for name in a
    )


def _points_in_order(mesh: Mesh, directions: np.ndarray) -> np.ndarray:
    """Return directions (m, 3) or (m, q, 3), points independent of the order of the corners."""
    if directions.ndim == 2:
        return directions
    ranks = np.argsort(mesh.corners, axis=1)
    barycentric = quadrature_points(mesh.order)[:, ranks].transpose(1, 0, 2)  # (m, q, 4)
    order = np.argsort(barycentric @ [1.0, 1e2, 1e4, 1e6], axis=1, kind="stable")
    return np.take_along_axis(directions, order[:, :, None], axis=1)


def _as_set(facets: np.ndarray) -> np.ndarray:
    """Return facets (k, 3 or 6) in a fixed order: nodes sorted in each, then whole rows."""
    return np.unique(np.sort(facets, axis=1), axis=0)


def _text(content: Any) -> bytes:
    return json.dumps(content, sort_keys=True).encode()
