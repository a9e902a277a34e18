"""The identity of a scene: everything its solutions depend on, in a canonical form.

The form does not depend on the order of tetrahedra and facets, nor on the order of theta or its
ranges. Two scenes have equal solutions if their identities agree; a scene's *fingerprint*
hashes its identity together with theta's order and box. Emulators and posteriors store the
fingerprint and refuse a scene whose fingerprint differs.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from emulator.geometry.discretisation import quadrature_points
from emulator.geometry.mesh import Mesh
from emulator.scenes.parameter_space import ParameterSpace

# Decimals of lengths in mm that the fingerprint hashes: 1 nm, so that round-off, which differs
# between machines, hardly ever decides on one.
_LENGTH_DIGITS = 6
_DIRECTION_DIGITS = 6  # decimals of unit vectors; some files store them in single precision
_TOLERANCE = 1e-6  # lengths relative to the body's size, and directions, agree within this
_HASH_LENGTH = 16  # hexadecimal digits


@dataclass(frozen=True, eq=False)
class Identity:
    """Everything the solutions of a scene depend on, apart from theta.

    lengths : arrays in mm by name: nodes, prescribed displacements.
    directions : unit vectors by name: fibres and sheets, if the scene has them.
    indices : arrays of whole numbers by name: tetrahedra, held, regions, facet sets under a load
        or a support.
    description : law, constants, loads, springs and the names of the parameters, plain JSON.
    """

    lengths: Mapping[str, np.ndarray]
    directions: Mapping[str, np.ndarray]
    indices: Mapping[str, np.ndarray]
    description: Mapping[str, Any]

    def agrees(self, other: Identity) -> bool:
        """Whether both scenes have equal solutions; the order of nodes must match."""
        size = float(np.linalg.norm(np.ptp(self.lengths["nodes"], axis=0)))
        return (
            _close(self.lengths, other.lengths, _TOLERANCE * size)
            and _close(self.directions, other.directions, _TOLERANCE)
            and _close(self.indices, other.indices, 0.0)
            and self.description == other.description
        )

    def parts(self) -> list[bytes]:
        """The identity as bytes to hash, lengths and directions rounded."""
        found = [_text(dict(self.description))]
        rounded = {name: np.round(v, _LENGTH_DIGITS) for name, v in self.lengths.items()}
        rounded |= {name: np.round(v, _DIRECTION_DIGITS) for name, v in self.directions.items()}
        for name, values in sorted(rounded.items()):
            # Adding 0.0 turns the -0.0 that rounding leaves into 0.0.
            found += [name.encode(), (values + 0.0).tobytes()]
        for name, values in sorted(self.indices.items()):
            found += [name.encode(), values.astype(np.int64).tobytes()]
        return found


def identity_of(
    mesh: Mesh,
    held: np.ndarray,
    moved: Mapping[str, np.ndarray],
    directions: Mapping[str, np.ndarray | None],
    regions: np.ndarray | None,
    facet_sets: Collection[str],
    description: Mapping[str, Any],
) -> Identity:
    """The identity of a scene made of these parts, elements put in a fixed order.

    Parameters
    ----------
    held : where the displacement is known, (n, 3) bool.
    moved : what is known of it, (n, 3) mm by name.
    directions : (m, 3) or (m, q, 3) unit vectors by name, or None.
    regions : (m,) labels, or None.
    facet_sets : names of the sets under a load or a support.
    """
    elements = np.sort(mesh.elements, axis=1)
    order = np.lexsort(elements.T)
    indices = {"elements": elements[order], "held": held}
    indices |= {f"facets {name}": _as_set(mesh.facet_set(name)) for name in facet_sets}
    if regions is not None:
        indices["regions"] = regions[order]
    return Identity(
        lengths={"nodes": mesh.nodes, **moved},
        directions={
            name: _points_in_order(mesh, v)[order]
            for name, v in directions.items()
            if v is not None
        },
        indices=indices,
        description=description,
    )


def plain_fields(part: Any, unused: Collection[str] = ()) -> list[Any]:
    """Kind and every field of a load or support, a frozen dataclass, as plain JSON.

    Numbers are floats, and -0.0 is 0.0; entries of a tuple stand one by one. A field that is
    ``unused`` is None.
    """
    found: list[Any] = [part.kind]
    for each in fields(part):
        value = None if each.name in unused else getattr(part, each.name)
        for entry in value if isinstance(value, tuple) else (value,):
            number = isinstance(entry, int | float) and not isinstance(entry, bool)
            found.append(float(entry) + 0.0 if number else entry)
    return found


def fingerprint(identity: Identity, space: ParameterSpace) -> str:
    """Short hash of an identity and of theta's order and box."""
    box = [[p.name, float(p.low), float(p.high), p.scale] for p in space.parameters]
    digest = hashlib.sha256()
    for part in [*identity.parts(), _text(box)]:
        # Lengths mark where each part ends, so that two lists of parts never hash alike.
        digest.update(len(part).to_bytes(8, "little"))
        digest.update(part)
    return digest.hexdigest()[:_HASH_LENGTH]


def _close(a: Mapping[str, np.ndarray], b: Mapping[str, np.ndarray], tolerance: float) -> bool:
    return a.keys() == b.keys() and all(
        a[name].shape == b[name].shape and np.allclose(a[name], b[name], rtol=0.0, atol=tolerance)
        for name in a
    )


def _points_in_order(mesh: Mesh, directions: np.ndarray) -> np.ndarray:
    """Directions (m, 3) or (m, q, 3), points in an order that does not depend on the corners'."""
    if directions.ndim == 2:
        return directions
    ranks = np.argsort(mesh.corners, axis=1)
    barycentric = quadrature_points(mesh.order)[:, ranks].transpose(1, 0, 2)  # (m, q, 4)
    order = np.argsort(barycentric @ [1.0, 1e2, 1e4, 1e6], axis=1, kind="stable")
    return np.take_along_axis(directions, order[:, :, None], axis=1)


def _as_set(facets: np.ndarray) -> np.ndarray:
    """Facets (k, 3 or 6) without regard to order: nodes sorted in each, then whole rows."""
    return np.unique(np.sort(facets, axis=1), axis=0)


def _text(content: Any) -> bytes:
    return json.dumps(content, sort_keys=True).encode()
