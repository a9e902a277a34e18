"""FEM runs of a campaign's Zarr store, to learn from."""

from __future__ import annotations

import hashlib
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.fem.campaign.runs import Runs, StoredRuns
from emulator.fem.campaign.zarr_rows import MISSING, read, require_store
from emulator.fem.solution import Status
from emulator.scenes.scene import Scene


def read_runs(path: str | Path, scene: Scene) -> StoredRuns:
    """The converged rows of a campaign, in the order of its design.

    Raises
    ------
    InputError
        No campaign, one of another scene, one that is not complete, or none that converged.
    """
    group = require_store(path)
    if group.attrs["fingerprint"] != scene.fingerprint:
        raise InputError(
            f"campaign {path} is of scene '{group.attrs['scene']}' with another mesh, law, load or "
            f"range than '{scene.name}'"
        )
    status = read(group, "status")
    missing = int((status == MISSING).sum())
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
    runs = Runs(*(jnp.asarray(read(group, name)[rows]) for name in names))
    words = " ".join(read(group, "hash")[rows].tolist())
    return StoredRuns(runs, hashlib.sha256(words.encode()).hexdigest()[:16])
