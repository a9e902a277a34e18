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
import tempfile
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

import jax.numpy as jnp
import numpy as np
import zarr

from emulator.core.errors import InputError
from emulator.core.store import exclusive
from emulator.fem.campaign.campaign import Field, Runs, StoredRuns
from emulator.fem.campaign.workers import Row, Solver
from emulator.fem.simulator import Simulator
from emulator.fem.solution import Status
from emulator.scenes.scene import Scene, with_mesh

_MISSING = -1
_FORMAT = 1
_CHUNK = 1024  # rows whose numbers are one file
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
        return with_mesh(self.solver.simulator.scene)

    @property
    def options(self) -> dict[str, Any]:
        """Everything that rows depend on besides scene and theta, as plain JSON."""
        newton = asdict(cast(Simulator, self.solver.simulator).options)
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
        self._arrays: dict[str, Any] = dict(group.arrays())
        self.thetas = _read(group, "theta")
        self._status = _read(group, "status")
        self._converged = np.flatnonzero(self._status == Status.CONVERGED).tolist()

    def missing(self) -> list[int]:
        """Return the numbers of the theta that have no row."""
        return np.flatnonzero(self._status == _MISSING).tolist()

    def __len__(self) -> int:
        return len(self._converged)

    def __iter__(self) -> Iterator[int]:
        return iter(self._converged)

    def __getitem__(self, number: int) -> Field:
        if self._status[number] != Status.CONVERGED:
            raise KeyError(number)
        slopes = self._arrays.get("sensitivities")
        u = self._arrays["displacement"][number]
        return Field(u, None if slopes is None else slopes[number])

    def write(self, row: Row) -> None:
        """Write a row, its status last."""
        row = row.as_numpy()
        number, solution = row.number, row.solution
        values = {
            "displacement": solution.displacement if row.converged else np.nan,
            "sensitivities": row.sensitivities,
            "energy": row.energy,
            "iterations": solution.iterations,
            "seconds": row.seconds,
            "status": solution.status,
        }
        for name, value in values.items():
            if value is not None:
                self._arrays[name][number] = value
        self._status[number] = solution.status
        if row.converged:
            self._converged.append(number)


@contextmanager
def writing(path: str | Path, campaign: Campaign) -> Iterator[ZarrRows]:
    """Yield the store at ``path``, made if it is not there, and keep other processes from writing.

    Raises :class:`InputError`: something else is there, another campaign, or one that is being run.
    """
    path = Path(path)
    if path.is_symlink() or path.exists():
        _open_store(path)
    with exclusive(path, "campaign"):
        if not path.exists():  # written completely or not at all
            with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder:
                make_store(Path(folder) / "store", campaign)
                (Path(folder) / "store").rename(path)
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


def make_store(store: Any, campaign: Campaign) -> zarr.Group:
    """Make a group without rows in ``store``, a path or a Zarr store."""
    scene, thetas = campaign.scene, campaign.thetas
    attributes = {
        "kind": "campaign",
        "format": _FORMAT,
        "scene": scene.name,
        "fingerprint": scene.fingerprint,
        "origin": json.loads(json.dumps(dict(scene.origin))),
        "options": campaign.options,
        **campaign.about,
    }
    group = zarr.open_group(store, mode="w-", zarr_format=3, attributes=attributes)
    rows, by_row = len(thetas), ("theta_id",)
    field = {"node": len(scene.mesh.nodes), "xyz": 3}

    def filled(name: str, values: Any, dimensions: tuple[str, ...], **attrs: Any) -> None:
        if isinstance(values, list):
            values = np.array(values, dtype=np.dtypes.StringDType())
        group.create_array(name, data=values, dimension_names=dimensions, attributes=attrs)

    def empty(
        name: str, dtype: str = "float64", dimensions: Mapping[str, int] = {}, **attrs: Any
    ) -> None:
        shape = tuple(dimensions.values())
        group.create_array(
            name,
            shape=(rows, *shape),
            chunks=(1, *shape) if shape else (_CHUNK,),
            dtype=dtype,
            fill_value=np.nan if dtype == "float64" else _MISSING,
            dimension_names=(*by_row, *dimensions),
            attributes=attrs,
        )

    filled("xyz", ["x", "y", "z"], ("xyz",))
    filled("parameter", list(scene.parameter_names), ("parameter",))
    filled("unit", [p.unit for p in scene.parameters], ("parameter",), long_name="of theta")
    filled("theta", thetas, (*by_row, "parameter"))
    filled("hash", campaign.hashes(thetas), by_row, long_name="SHA-256 of scene, theta and options")
    filled("reference", np.asarray(scene.mesh.nodes), tuple(field), units="mm")
    empty("displacement", dimensions=field, units="mm")
    if campaign.solver.sensitivities:
        by_parameter = {"parameter": len(scene.parameters), **field}
        about = "du/dtheta, mm per unit of each parameter"
        empty("sensitivities", dimensions=by_parameter, long_name=about)
    empty("energy", units="mN mm")
    empty("iterations", "int32")
    empty("seconds", units="s")
    meanings = " ".join(_WORDS.values())
    empty("status", "int8", flag_values=list(_WORDS), flag_meanings=meanings)
    with warnings.catch_warnings():
        # Zarr warns that the format's text does not have it yet; xarray warns where it is absent.
        warnings.simplefilter("ignore")
        zarr.consolidate_metadata(group.store)
    return group


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
