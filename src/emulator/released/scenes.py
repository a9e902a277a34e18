"""The models released with Dalton et al. (2023), in mm and kPa: scenes and FEniCS test solutions.

The folder layout is the release's, ``<model>/geometryData`` and ``<model>/simulationData/test``: a
clone of the release, or its folder ``data``, can be read as it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError, look_up
from emulator.geometry.mesh import Mesh, boundary_facets, orient
from emulator.mechanics.laws import find_law
from emulator.scenes.loads import Gravity, Load, PublishedPressure
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.scene import ENDOCARDIUM, Scene
from emulator.scenes.supports import Support

_POINTER = b"version https://git-lfs"  # first bytes of a git-lfs file that was not fetched
_GRAVITY = Gravity(density=1.0, direction=(0.0, 0.0, -1.0), acceleration=9.80)


class PublishedUnits(NamedTuple):
    """Factors from a model's own units: length to mm, stress to kPa."""

    length: float
    stress: float

    @property
    def energy(self) -> float:
        """Factor from the model's energy to mN mm (kPa mm3)."""
        return self.stress * self.length**3


_CGS = PublishedUnits(length=10.0, stress=1e-4)


class _Model(NamedTuple):
    """A released model: its units, law, parameters, loads and constants.

    parameters : in the order of the stored theta.
    """

    units: PublishedUnits
    law: str
    parameters: tuple[Parameter, ...]
    loads: tuple[Load, ...] = ()
    constants: Mapping[str, float] = MappingProxyType({})


_BEAM = _Model(
    _CGS,
    "neo_hookean",
    (Parameter("mu", "kPa", 50.0, 100.0, "log"), Parameter("lam", "kPa", 50.0, 100.0, "log")),
    (_GRAVITY,),
)
_MODELS = {
    "OnceClampedBeam": _BEAM,
    "TwiceClampedBeam": _BEAM,
    "TwistingBeam": _Model(
        PublishedUnits(length=1.0, stress=1.0),  # dimensionless
        "neo_hookean_E_nu",
        (Parameter("E", "kPa", 1.0, 25.0, "log"), Parameter("nu", "", 0.1, 0.4, "log")),
    ),
    "Liver": _Model(
        _CGS,
        "neo_hookean",
        (Parameter("lam", "kPa", 3.5, 10.0, "log"), Parameter("mu", "kPa", 3.5, 10.0, "log")),
        (_GRAVITY,),
    ),
    "LeftVentricle": _Model(
        PublishedUnits(length=10.0, stress=1.0),
        "holzapfel_ogden_released",
        (
            Parameter("a", "kPa", 0.1, 0.26, "log"),
            Parameter("b", "", 1.0, 4.2, "log"),
            Parameter("a_f", "kPa", 1.5, 5.18, "log"),
            Parameter("b_f", "", 1.0, 4.46, "log"),
        ),
        (PublishedPressure(ENDOCARDIUM, pressure=1.06658),),  # 8 mmHg
        MappingProxyType({"kappa": 25.0}),
    ),
}
MODELS = tuple(_MODELS)


def _find(model: str) -> _Model:
    return look_up(_MODELS, model, "published model")


def units(model: str) -> PublishedUnits:
    """Return the units of ``model``; :class:`InputError` lists the known models."""
    return _find(model).units


def theta_units(model: str) -> np.ndarray:
    """Return the factors (p,) from the stored theta to the scene's."""
    stress = units(model).stress
    return np.array([stress if p.unit == "kPa" else 1.0 for p in _find(model).parameters])


def published_scene(model: str, root: str | Path) -> Scene:
    """Return the scene of a released model, read from ``root``.

    Its mesh has the node set ``held`` and, if released, the pressed facets.
    """
    description = _find(model)
    scale, folder = description.units.length, "geometryData"
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
    prescribed = _read_optional(root, model, f"{folder}/disp-add.npy", nodes.shape)
    displacement = np.zeros((len(held), 3)) if prescribed is None else prescribed[held] * scale
    elements = orient(nodes, elements)  # elements and facets of the release are not oriented
    fibres = _read_optional(
        root, model, f"{folder}/fibre-field-elementwise.npy", (len(elements), 3, 1)
    )
    if fibres is not None:
        fibres = fibres[:, :, 0].astype(float)
        fibres = fibres / np.linalg.norm(fibres, axis=1, keepdims=True)  # stored in float32
    return Scene(
        name=f"published:{model}",
        mesh=Mesh(nodes, elements, {"held": held}, _pressed_facets(root, model, elements)),
        law=find_law(description.law),
        parameters=description.parameters,
        loads=description.loads,
        supports=(Support("held", displacement),),
        constants=description.constants,
        fibres=fibres,
        origin={"scene": f"published:{model}", "root": str(Path(root).resolve())},
    )


def _pressed_facets(root: str | Path, model: str, elements: np.ndarray) -> dict[str, np.ndarray]:
    """Read the facets under pressure and orient them; nothing where none are released."""
    part = "geometryData/pressure-surface-facets.npy"
    rows = _read_optional(root, model, part, (None, 4))
    if rows is None:
        return {}
    surface = boundary_facets(elements)
    loaded = {tuple(row) for row in np.sort(rows[:, 1:], axis=1).tolist()}
    inside = [tuple(row) in loaded for row in np.sort(surface, axis=1).tolist()]
    if sum(inside) < len(loaded):
        raise InputError(
            f"published data: {len(loaded) - sum(inside)} of the {len(loaded)} pressed facets "
            f"of {model} are not on the surface of its elements"
        )
    return {ENDOCARDIUM: surface[inside]}


class PublishedTests(NamedTuple):
    """The test solutions of a model.

    energy : (c,) least potential energy, mN mm.
    displacement : (c, n, 3) mm, or None where the release has none.
    """

    energy: np.ndarray
    displacement: np.ndarray | None


def published_tests(model: str, root: str | Path) -> tuple[jax.Array, PublishedTests]:
    """Return theta (c, p) in the scene's units, and the stored solutions at these theta."""
    unit, folder = units(model), "simulationData/test"
    theta = read_array(root, model, f"{folder}/theta.npy", (None, None))
    shape = (len(theta), None, 3)
    displacement = _read_optional(root, model, f"{folder}/displacement.npy", shape)
    energy = read_array(root, model, f"{folder}/pe-values.npy", (len(theta),)) * unit.energy
    scale = theta_units(model)
    if theta.shape[1] != len(scale):
        raise InputError(f"published model '{model}': theta has shape {theta.shape}")
    in_mm = None if displacement is None else displacement * unit.length
    return jnp.asarray(theta) * scale, PublishedTests(energy, in_mm)


# ---- files ---------------------------------------------------------------------------------------
def folder_of(root: str | Path, model: str) -> Path:
    """Return the folder of ``model`` in the release's folder ``data`` or in a clone of it all."""
    subfolder = Path(root) / "data" / model
    return subfolder if subfolder.is_dir() else Path(root) / model


def models_in(root: str | Path) -> tuple[str, ...]:
    """Return the released models whose folder is in ``root``."""
    return tuple(model for model in MODELS if folder_of(root, model).is_dir())


def read_array(
    root: str | Path, model: str, part: str, shape: tuple[int | None, ...] | None = None
) -> np.ndarray:
    """Read an array of finite numbers.

    part : the path in the model's folder. shape : the right shape, None standing for any length.
    """
    folder = folder_of(root, model)
    path = folder / part
    if not path.is_file():
        remedy = f"give the folder that holds {model}/"
        if folder.is_dir():
            remedy = "the clone lacks it, perhaps for its size: fetch that file"
        raise InputError(f"published data: {path} is missing; {remedy}")
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
        expected = tuple("any" if length is None else length for length in shape)
        raise InputError(f"published data: {path} has shape {array.shape}; expected {expected}")
    if not np.isfinite(array).all():
        raise InputError(f"published data: {path} has values that are not finite")
    return array


def _read_optional(
    root: str | Path, model: str, part: str, shape: tuple[int | None, ...]
) -> np.ndarray | None:
    """Read an array, or None where the release has no such file."""
    present = (folder_of(root, model) / part).is_file()
    return read_array(root, model, part, shape) if present else None
