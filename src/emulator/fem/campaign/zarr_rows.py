"""Rows of a campaign in a Zarr store, which ``xarray.open_zarr`` reads.

========================  ==========================================================
``theta``                 (theta_id, parameter), the design, whole from the beginning
``unit``                  (parameter,), of theta
``hash``                  (theta_id,), SHA-256 of scene, theta and options
``reference``             (node, xyz) mm, the undeformed body
``displacement``          (theta_id, node, xyz) mm
``sensitivities``         (theta_id, parameter, node, xyz), du/dtheta in mm per unit, if requested
``energy``                (theta_id,) mN mm
``iterations, seconds``   (theta_id,)
``status``                (theta_id,), a :class:`~emulator.fem.solution.Status`; -1 is not solved
========================  ==========================================================

Where a solve failed, its displacement, sensitivities and energy are NaN. Each theta has one place,
so no row can be there twice. Its status is written last, and each file is replaced as a whole, so
a row is whole or counts as missing, whenever the process is killed. One process writes at a time.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from emulator.core.errors import InputError
from emulator.core.store import exclusive
from emulator.fem.campaign.engine import Solver
from emulator.fem.campaign.row import Row
from emulator.fem.campaign.starts import Field
from emulator.fem.solution import Status
from emulator.scenes.scene import Scene

MISSING = -1
_FORMAT = 1
_TOGETHER = 1024  # rows whose numbers are one file
_NUMBERS = ("energy", "iterations", "seconds", "status")
_CLOSE = 1e-9  # relative; theta of one design differ by round-off between machines
WORDS = {MISSING: "not_solved"} | {
    int(s): s.name.lower() for s in Status if s is not Status.RUNNING
}


@dataclass(frozen=True, eq=False)
class Question:
    """What a campaign asks: FEM's answer at every theta.

    solver : of the scene, with its options. thetas : (c, p).
    about : how the design was made, versions and the like, as plain JSON.
    """

    solver: Solver
    thetas: np.ndarray
    about: Mapping[str, Any]

    @property
    def scene(self) -> Scene:
        """The scene that is solved."""
        return self.solver.simulator.scene

    @property
    def options(self) -> dict[str, Any]:
        """Everything rows depend on besides scene and theta, plain JSON."""
        newton = asdict(self.solver.simulator.options)
        return {"newton": newton, "sensitivities": self.solver.sensitivities}

    def hashes(self, thetas: np.ndarray) -> list[str]:
        """SHA-256 of each row's scene, theta and options."""
        common = f"{self.scene.fingerprint} {json.dumps(self.options, sort_keys=True)} "
        return [
            hashlib.sha256(common.encode() + np.asarray(theta, "<f8").tobytes()).hexdigest()
            for theta in thetas
        ]


class ZarrRows:
    """Rows in a Zarr group; :func:`open_rows` makes it."""

    def __init__(self, group: zarr.Group) -> None:
        self._group = group
        self.thetas = read(group, "theta")
        self._numbers = {name: read(group, name) for name in _NUMBERS}
        self._converged = np.flatnonzero(self._numbers["status"] == Status.CONVERGED).tolist()

    def missing(self) -> list[int]:
        """Numbers of the theta that have no row."""
        return np.flatnonzero(self._numbers["status"] == MISSING).tolist()

    def converged(self) -> list[int]:
        """Numbers of the rows that did; those solved by this process in the order they were."""
        return self._converged

    def field(self, number: int) -> Field:
        """The solution of a row that converged, read from the store."""
        slopes = self._arrays.get("sensitivities")
        return Field(
            self._arrays["displacement"][number], None if slopes is None else slopes[number]
        )

    def write(self, row: Row) -> None:
        """Write a row, its status last."""
        row = row.as_numpy()
        number, solution = row.number, row.solution
        self._arrays["displacement"][number] = solution.displacement if row.converged else np.nan
        if row.sensitivities is not None:
            self._arrays["sensitivities"][number] = row.sensitivities
        self._set("energy", number, row.energy)
        self._set("iterations", number, solution.iterations)
        self._set("seconds", number, row.seconds)
        self._set("status", number, solution.status)
        if row.converged:
            self._converged.append(number)

    def _set(self, name: str, number: int, value: Any) -> None:
        """Write one number with all that are in its file, so that nothing need be read first."""
        self._numbers[name][number] = value
        first = number - number % _TOGETHER
        part = slice(first, first + _TOGETHER)
        self._arrays[name][part] = self._numbers[name][part]

    @cached_property
    def _arrays(self) -> dict[str, Any]:
        return dict(self._group.arrays())


@contextmanager
def writing(path: str | Path, question: Question) -> Iterator[ZarrRows]:
    """The store at ``path``, made if it is not there; no other process writes to it meanwhile.

    Raises
    ------
    InputError
        Something else is there, a campaign that asks something else, or one that is being run.
    """
    path = Path(path)
    if path.is_symlink() or path.exists():
        require_store(path)
    with exclusive(path, "campaign"):
        if not path.exists():
            _make_at(path, question)
        group = zarr.open_group(path, mode="r+", use_consolidated=False)
        _check_question(path, group, question)
        yield ZarrRows(group)


def require_store(path: str | Path) -> zarr.Group:
    """The campaign at ``path``, to read; :class:`InputError` where there is none."""
    path = Path(path)
    with suppress(OSError, ValueError, KeyError):
        group = zarr.open_group(path, mode="r")
        if group.attrs.get("format") == _FORMAT and group.attrs.get("kind") == "campaign":
            return group
    what = "is not a campaign's Zarr store" if path.exists() else "does not exist"
    raise InputError(f"campaign {path} {what}")


def read(group: Any, name: str) -> np.ndarray:
    """The whole array of that name."""
    return np.asarray(group[name][...])


def _check_question(path: Path, group: zarr.Group, question: Question) -> None:
    """Refuse a store of other theta, another scene or other options."""
    scene, attrs = question.scene, dict[str, Any](group.attrs)
    if attrs["fingerprint"] != scene.fingerprint:
        raise InputError(
            f"campaign {path} is of scene '{attrs['scene']}' with another mesh, law, load or range "
            f"than '{scene.name}'; give another --out"
        )
    for name, value in {**question.about.get("design", {}), **question.options}.items():
        there = {**attrs["design"], **attrs["options"]}.get(name)
        if there != json.loads(json.dumps(value)):
            raise InputError(
                f"campaign {path} has {name} {_short(there)}, not {_short(value)}; repeat it as it "
                "was, or give another --out"
            )
    theta = read(group, "theta")
    same = theta.shape == question.thetas.shape
    if not same or not np.allclose(theta, question.thetas, rtol=_CLOSE, atol=0.0, equal_nan=True):
        raise InputError(f"campaign {path} has other theta; give another --out")
    if question.hashes(theta) != read(group, "hash").tolist():
        raise InputError(f"campaign {path}: its hashes are not those of its theta; it was changed")


def _short(value: Any) -> str:
    return "other solver options" if isinstance(value, dict) else str(value)


def _make_at(path: Path, question: Question) -> None:
    """A store without rows, there whole or not at all."""
    temporary = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
    try:
        make_store(temporary / "store", question)
        (temporary / "store").rename(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def make_store(store: Any, question: Question) -> zarr.Group:
    """A group without rows in ``store``, a path or a Zarr store."""
    scene, thetas = question.scene, question.thetas
    group = zarr.open_group(store, mode="w-", zarr_format=3, attributes=_attributes(question))
    rows, nodes = len(thetas), len(scene.mesh.nodes)
    by_row, field = ("theta_id",), ("node", "xyz")

    def given(name: str, values: Any, dimensions: tuple[str, ...], **attrs: Any) -> None:
        if isinstance(values, list):
            values = np.array(values, dtype=np.dtypes.StringDType())
        group.create_array(name, data=values, dimension_names=dimensions, attributes=attrs)

    def empty(name: str, shape: tuple[int, ...], dimensions: tuple[str, ...], **attrs: Any) -> None:
        group.create_array(
            name,
            shape=(rows, *shape),
            chunks=(1, *shape) if shape else (_TOGETHER,),
            dtype=attrs.pop("dtype", "float64"),
            fill_value=attrs.pop("missing", np.nan),
            dimension_names=(*by_row, *dimensions),
            attributes=attrs,
        )

    given("xyz", ["x", "y", "z"], ("xyz",))
    given("parameter", list(scene.parameter_names), ("parameter",))
    given("unit", [p.unit for p in scene.parameters], ("parameter",), long_name="of theta")
    given("theta", thetas, (*by_row, "parameter"))
    given("hash", question.hashes(thetas), by_row, long_name="SHA-256 of scene, theta and options")
    given("reference", np.asarray(scene.mesh.nodes), field, units="mm")
    empty("displacement", (nodes, 3), field, units="mm")
    if question.solver.sensitivities:
        shape = (len(scene.parameters), nodes, 3)
        about = "du/dtheta, mm per unit of each parameter"
        empty("sensitivities", shape, ("parameter", *field), long_name=about)
    empty("energy", (), (), units="mN mm")
    empty("iterations", (), (), dtype="int32", missing=MISSING)
    empty("seconds", (), (), units="s")
    empty(
        "status",
        (),
        (),
        dtype="int8",
        missing=MISSING,
        flag_values=list(WORDS),
        flag_meanings=" ".join(WORDS.values()),
    )
    with warnings.catch_warnings():
        # Zarr warns that the format's text does not have it yet; xarray warns where it is absent.
        warnings.simplefilter("ignore")
        zarr.consolidate_metadata(group.store)
    return group


def _attributes(question: Question) -> dict[str, Any]:
    """What the store says of itself, plain JSON."""
    scene = question.scene
    return {
        "kind": "campaign",
        "format": _FORMAT,
        "scene": scene.name,
        "fingerprint": scene.fingerprint,
        "origin": json.loads(json.dumps(dict(scene.origin))),
        "options": question.options,
        **question.about,
    }
