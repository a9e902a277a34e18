"""Reader of the data released with Dalton et al. (2023): geometry and FEniCS test solutions.

The folder layout is the release's, ``<model>/geometryData`` and ``<model>/simulationData/test``: a
clone of the release, or its folder ``data``, can be read as it is. Lengths are converted to mm,
stresses to kPa, energies to mN mm.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from emulator.core.errors import InputError, look_up
from emulator.geometry.mesh import Mesh, boundary_facets, orient


@dataclass(frozen=True)
class PublishedUnits:
    """Factors from a model's own units: length to mm, stress to kPa."""

    length: float
    stress: float

    @property
    def energy(self) -> float:
        """Factor from the model's energy to mN mm (kPa mm3)."""
        return self.stress * self.length**3


PRESSURE_SURFACE = "endocardium"
_POINTER = b"version https://git-lfs"  # first bytes of a git-lfs file that was not fetched
_CGS = PublishedUnits(length=10.0, stress=1e-4)
UNITS = {
    "OnceClampedBeam": _CGS,
    "TwiceClampedBeam": _CGS,
    "TwistingBeam": PublishedUnits(length=1.0, stress=1.0),  # dimensionless
    "Liver": _CGS,
    "LeftVentricle": PublishedUnits(length=10.0, stress=1.0),
}


@dataclass(frozen=True, eq=False)
class PublishedGeometry:
    """Geometry of a model.

    mesh : in mm. displacement : (k, 3) mm, prescribed on its node set ``held``.
    fibres : (m, 3) unit vectors, or ``None``.
    """

    mesh: Mesh
    displacement: np.ndarray
    fibres: np.ndarray | None


@dataclass(frozen=True, eq=False)
class PublishedTests:
    """Test solutions of a model.

    theta : (c, p) as stored, in the model's units.
    energy : (c,) least potential energy, mN mm.
    displacement : (c, n, 3) mm, or ``None`` where the release has none.
    """

    theta: np.ndarray
    energy: np.ndarray
    displacement: np.ndarray | None


Shape = tuple[int | None, ...]


def read_array(root: str | Path, model: str, part: str, shape: Shape | None = None) -> np.ndarray:
    """A finite array of the given shape, ``None`` standing for any length."""
    path = folder_of(root, model) / part
    if not path.is_file():
        raise InputError(f"published data: {path} is missing; {_remedy(root, model)}")
    try:
        array = np.load(path, allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        what = "is not a readable .npy array"
        if path.read_bytes()[: len(_POINTER)] == _POINTER:
            what = "is a pointer to a large file that the clone has not fetched; run git lfs pull"
        raise InputError(f"published data: {path} {what}") from error
    if shape is not None and (
        array.ndim != len(shape)
        or any(want not in (None, have) for want, have in zip(shape, array.shape, strict=True))
    ):
        wanted = tuple("any" if length is None else length for length in shape)
        raise InputError(f"published data: {path} has shape {array.shape}; expected {wanted}")
    if not np.isfinite(array).all():
        raise InputError(f"published data: {path} has values that are not finite")
    return array


def read_array_if_there(root: str | Path, model: str, part: str, shape: Shape) -> np.ndarray | None:
    """The array, or ``None`` where the release has no such file."""
    there = (folder_of(root, model) / part).is_file()
    return read_array(root, model, part, shape) if there else None


def folder_of(root: str | Path, model: str) -> Path:
    """Folder of ``model`` in the release's folder ``data`` or in a clone of the whole release."""
    inside = Path(root) / "data" / model
    return inside if inside.is_dir() else Path(root) / model


def _remedy(root: str | Path, model: str) -> str:
    if folder_of(root, model).is_dir():
        return "the clone lacks it, perhaps for its size: fetch that file"
    return f"give the folder that holds {model}/"


def models_in(root: str | Path) -> tuple[str, ...]:
    """Released models whose folder is in ``root``."""
    return tuple(model for model in UNITS if folder_of(root, model).is_dir())


def units(model: str) -> PublishedUnits:
    """Units of ``model``; :class:`InputError` lists the known models."""
    return look_up(UNITS, model, "published model")


def read_geometry(root: str | Path, model: str) -> PublishedGeometry:
    """The mesh of ``model`` in mm, with node set ``held`` and, if released, the pressed facets."""
    scale, folder = units(model).length, "geometryData"
    nodes = read_array(root, model, f"{folder}/reference-coords.npy", (None, 3)) * scale
    elements = read_array(root, model, f"{folder}/elements.npy", (None, 4)).astype(np.int64)
    if elements.min() < 0 or elements.max() >= len(nodes):
        raise InputError(f"published data: elements of {model} name nodes there are none of")
    interior = read_array(root, model, f"{folder}/interior-points.npy").reshape(-1)
    if len(interior) != len(nodes):
        raise InputError(
            f"published data: {model} marks {len(interior)} nodes but has {len(nodes)}"
        )
    held = np.flatnonzero(~interior.astype(bool))
    moved = read_array_if_there(root, model, f"{folder}/disp-add.npy", nodes.shape)
    displacement = np.zeros((len(held), 3)) if moved is None else moved[held] * scale
    # The release does not orient its elements and facets.
    elements = orient(nodes, elements)
    pressed = read_array_if_there(root, model, f"{folder}/pressure-surface-facets.npy", (None, 4))
    facets = {}
    if pressed is not None:
        surface = boundary_facets(elements)
        wanted = {tuple(row) for row in np.sort(pressed[:, 1:], axis=1).tolist()}
        inside = [tuple(row) in wanted for row in np.sort(surface, axis=1).tolist()]
        if sum(inside) < len(wanted):
            raise InputError(
                f"published data: {len(wanted) - sum(inside)} of the {len(wanted)} pressed facets "
                f"of {model} are not on the surface of its elements"
            )
        facets[PRESSURE_SURFACE] = surface[inside]
    fibres = read_array_if_there(
        root, model, f"{folder}/fibre-field-elementwise.npy", (len(elements), 3, 1)
    )
    if fibres is not None:
        fibres = fibres[:, :, 0].astype(float)
        fibres = fibres / np.linalg.norm(fibres, axis=1, keepdims=True)  # stored in float32
    mesh = Mesh(nodes, elements, {"held": held}, facets)
    return PublishedGeometry(mesh, displacement, fibres)


def read_tests(root: str | Path, model: str) -> PublishedTests:
    """The test solutions of ``model``."""
    unit, folder = units(model), "simulationData/test"
    theta = read_array(root, model, f"{folder}/theta.npy", (None, None))
    shape = (len(theta), None, 3)
    displacement = read_array_if_there(root, model, f"{folder}/displacement.npy", shape)
    return PublishedTests(
        theta=theta,
        energy=read_array(root, model, f"{folder}/pe-values.npy", (len(theta),)) * unit.energy,
        displacement=None if displacement is None else displacement * unit.length,
    )
