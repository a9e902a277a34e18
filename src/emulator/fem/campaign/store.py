"""The rows of a campaign in a Zarr store, which ``xarray.open_zarr`` reads.

========================  ==========================================================
``theta``                 (theta_id, parameter), the design, complete from the beginning
``unit``                  (parameter,), of theta
``hash``                  (theta_id,), SHA-256 of scene, theta and options
``reference``             (node, xyz) mm, the undeformed body
``displacement``          (theta_id, node, xyz) mm
``sensitivities``         (theta_id, parameter, node, xyz), du/dtheta in mm per unit, if requested
``energy``                (theta_id,) mN mm
``iterations, seconds``   (theta_id,)
``status``                (theta_id,), a :class:`~emulator.fem.solution.Status`; -1 is not solved
========================  ==========================================================

Where a solve failed, its displacement, sensitivities and energy are NaN. Each theta has one
position, so no row is stored twice. Its status is written last, and each file is replaced as a
whole, so a row is complete or counts as missing, whenever the process is killed. One process writes
at a time.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import zarr

from emulator.core.errors import InputError
from emulator.core.store import exclusive
from emulator.fem.campaign.campaign import Field, Runs, StoredRuns
from emulator.fem.campaign.workers import Row, Solver
from emulator.fem.solution import Status
from emulator.scenes.scene import Scene

_MISSING = -1
_FORMAT = 1
_CHUNK = 1024  # rows whose numbers are one file
_NUMBERS = ("energy", "iterations", "seconds", "status")
_ROUND_OFF = 1e-9  # relative; theta of one design differ by round-off between machines
_WORDS = {_MISSING: "not_solved"} | {
    int(s): s.name.lower() for s in Status if s is not Status.RUNNING
}


@dataclass(frozen=True, eq=False)
class Campaign:
    """The description of a campaign: a solve at every theta of a design.

    solver : the solver of the scene, with its options. thetas : (c, p).
    about : the origin of the design, versions and the like, as plain JSON.
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
        """Everything that rows depend on besides scene and theta, as plain JSON."""
        newton = asdict(self.solver.simulator.options)
        return {"newton": newton, "sensitivities": self.solver.sensitivities}

    def hashes(self, thetas: np.ndarray) -> list[str]:
        """Return the SHA-256 of the scene, theta and options of each row."""
        common = f"{self.scene.fingerprint} {json.dumps(self.options, sort_keys=True)} "
        return [
            hashlib.sha256(common.encode() + np.asarray(theta, "<f8").tobytes()).hexdigest()
            for theta in thetas
        ]


class ZarrRows(Mapping[int, Field]):
    """Rows in a Zarr group, and a mapping from the numbers of converged rows to their solutions.

    :func:`writing` makes it. Rows solved by this process come in the order in which they were.
    """

    def __init__(self, group: zarr.Group) -> None:
        self._group = group
        self.thetas = _read(group, "theta")
        self._numbers = {name: _read(group, name) for name in _NUMBERS}
        self._converged = np.flatnonzero(self._numbers["status"] == Status.CONVERGED).tolist()

    def missing(self) -> list[int]:
        """Return the numbers of the theta that have no row."""
        return np.flatnonzero(self._numbers["status"] == _MISSING).tolist()

    def __len__(self) -> int:
        return len(self._converged)

    def __iter__(self) -> Iterator[int]:
        return iter(self._converged)

    def __getitem__(self, number: int) -> Field:
        if self._numbers["status"][number] != Status.CONVERGED:
            raise KeyError(number)
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
        """Write one number with all others of its file, so that nothing need be read first."""
        self._numbers[name][number] = value
        first = number - number % _CHUNK
        part = slice(first, first + _CHUNK)
        self._arrays[name][part] = self._numbers[name][part]

    @cached_property
    def _arrays(self) -> dict[str, Any]:
        return dict(self._group.arrays())


@contextmanager
def writing(path: str | Path, campaign: Campaign) -> Iterator[ZarrRows]:
    """Yield the store at ``path``, made if it is not there, and keep other processes from writing.

    Raises
    ------
    InputError
        Something else is there, another campaign, or one that is being run.
    """
    path = Path(path)
    if path.is_symlink() or path.exists():
        _open_store(path)
    with exclusive(path, "campaign"):
        if not path.exists():
            _make_at(path, campaign)
        group = zarr.open_group(path, mode="r+", use_consolidated=False)
        _check_campaign(path, group, campaign)
        yield ZarrRows(group)


def _open_store(path: str | Path) -> zarr.Group:
    """Return the campaign at ``path``, to read; :class:`InputError` where there is none."""
    path = Path(path)
    with suppress(OSError, ValueError, KeyError):
        group = zarr.open_group(path, mode="r")
        if group.attrs.get("format") == _FORMAT and group.attrs.get("kind") == "campaign":
            return group
    what = "is not a campaign's Zarr store" if path.exists() else "does not exist"
    raise InputError(f"campaign {path} {what}")


def _read(group: Any, name: str) -> np.ndarray:
    """Return the whole array of that name."""
    return np.asarray(group[name][...])


def _check_campaign(path: Path, group: zarr.Group, campaign: Campaign) -> None:
    """Refuse a store of another scene, other options or other theta."""
    _check_scene(path, group, campaign.scene, "; give another --out")
    attrs = dict[str, Any](group.attrs)
    for name, value in {**campaign.about.get("design", {}), **campaign.options}.items():
        stored = {**attrs["design"], **attrs["options"]}.get(name)
        if stored != json.loads(json.dumps(value)):
            raise InputError(
                f"campaign {path} has {name} {_short(stored)}, not {_short(value)}; repeat it as "
                "it was, or give another --out"
            )
    theta = _read(group, "theta")
    same = partial(np.allclose, rtol=_ROUND_OFF, atol=0.0, equal_nan=True)
    if theta.shape != campaign.thetas.shape or not same(theta, campaign.thetas):
        raise InputError(f"campaign {path} has other theta; give another --out")
    if campaign.hashes(theta) != _read(group, "hash").tolist():
        raise InputError(f"campaign {path}: its hashes are not those of its theta; it was changed")


def _check_scene(path: str | Path, group: zarr.Group, scene: Scene, remedy: str = "") -> None:
    """Refuse a store of another scene."""
    if group.attrs["fingerprint"] != scene.fingerprint:
        raise InputError(
            f"campaign {path} is of scene '{group.attrs['scene']}' with another mesh, law, load or "
            f"range than '{scene.name}'{remedy}"
        )


def _short(value: Any) -> str:
    return "other solver options" if isinstance(value, dict) else str(value)


def _make_at(path: Path, campaign: Campaign) -> None:
    """Write a store without rows, completely or not at all."""
    temporary = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
    try:
        make_store(temporary / "store", campaign)
        (temporary / "store").rename(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def make_store(store: Any, campaign: Campaign) -> zarr.Group:
    """Make a group without rows in ``store``, a path or a Zarr store."""
    scene, thetas = campaign.scene, campaign.thetas
    group = zarr.open_group(store, mode="w-", zarr_format=3, attributes=_attributes(campaign))
    rows, nodes = len(thetas), len(scene.mesh.nodes)
    by_row, field = ("theta_id",), ("node", "xyz")

    def filled(name: str, values: Any, dimensions: tuple[str, ...], **attrs: Any) -> None:
        if isinstance(values, list):
            values = np.array(values, dtype=np.dtypes.StringDType())
        group.create_array(name, data=values, dimension_names=dimensions, attributes=attrs)

    def empty(name: str, shape: tuple[int, ...], dimensions: tuple[str, ...], **attrs: Any) -> None:
        group.create_array(
            name,
            shape=(rows, *shape),
            chunks=(1, *shape) if shape else (_CHUNK,),
            dtype=attrs.pop("dtype", "float64"),
            fill_value=attrs.pop("missing", np.nan),
            dimension_names=(*by_row, *dimensions),
            attributes=attrs,
        )

    filled("xyz", ["x", "y", "z"], ("xyz",))
    filled("parameter", list(scene.parameter_names), ("parameter",))
    filled("unit", [p.unit for p in scene.parameters], ("parameter",), long_name="of theta")
    filled("theta", thetas, (*by_row, "parameter"))
    filled("hash", campaign.hashes(thetas), by_row, long_name="SHA-256 of scene, theta and options")
    filled("reference", np.asarray(scene.mesh.nodes), field, units="mm")
    empty("displacement", (nodes, 3), field, units="mm")
    if campaign.solver.sensitivities:
        shape = (len(scene.parameters), nodes, 3)
        about = "du/dtheta, mm per unit of each parameter"
        empty("sensitivities", shape, ("parameter", *field), long_name=about)
    empty("energy", (), (), units="mN mm")
    empty("iterations", (), (), dtype="int32", missing=_MISSING)
    empty("seconds", (), (), units="s")
    empty(
        "status",
        (),
        (),
        dtype="int8",
        missing=_MISSING,
        flag_values=list(_WORDS),
        flag_meanings=" ".join(_WORDS.values()),
    )
    with warnings.catch_warnings():
        # Zarr warns that the format's text does not have it yet; xarray warns where it is absent.
        warnings.simplefilter("ignore")
        zarr.consolidate_metadata(group.store)
    return group


def _attributes(campaign: Campaign) -> dict[str, Any]:
    """Return the attributes of the store, plain JSON."""
    scene = campaign.scene
    return {
        "kind": "campaign",
        "format": _FORMAT,
        "scene": scene.name,
        "fingerprint": scene.fingerprint,
        "origin": json.loads(json.dumps(dict(scene.origin))),
        "options": campaign.options,
        **campaign.about,
    }


def count_statuses(path: str | Path) -> dict[str, int]:
    """Return the number of rows with each status, by its name, the most frequent first."""
    status = _read(_open_store(path), "status")
    return {_WORDS[value]: count for value, count in Counter(status.tolist()).most_common()}


def read_runs(path: str | Path, scene: Scene) -> StoredRuns:
    """Return the converged rows of a campaign, in the order of its design.

    Raises
    ------
    InputError
        No campaign, one of another scene, one that is not complete, or none that converged.
    """
    group = _open_store(path)
    _check_scene(path, group, scene)
    status = _read(group, "status")
    missing = int((status == _MISSING).sum())
    if missing:
        raise InputError(
            f"campaign {path}: {missing} of {len(status)} theta are not solved; give its command "
            "again to complete it"
        )
    rows = np.flatnonzero(status == Status.CONVERGED)
    if not rows.size:
        raise InputError(f"campaign {path}: none of {len(status)} theta converged")
    names = ["theta", "displacement", "energy"]
    names += ["sensitivities"] if "sensitivities" in group else []
    runs = Runs(*(jnp.asarray(_read(group, name)[rows]) for name in names))
    hashes = " ".join(_read(group, "hash")[rows].tolist())
    return StoredRuns(runs, hashlib.sha256(hashes.encode()).hexdigest()[:16])
