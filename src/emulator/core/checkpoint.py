"""A run's state on disk, from which a killed run continues: of samplers and of trainings.

A state is a pytree of arrays. It is written every few seconds, whole or not at all, together with
the run's identity: all that the state depends on, such as data, options and seed. The state does
not depend on the clock, so a resumed run gives the result of an uninterrupted one, bit for bit.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.core.store import named_leaves, read_arrays, save_arrays

FORMAT = "1"  # format of the states; a file of another format is refused
_LONG = 60  # characters of a value that a message leaves out


class Checkpoint:
    """The file that a run's state is written to.

    Parameters
    ----------
    path : a safetensors file; ``None`` for no checkpoint.
    identity : the JSON values by name that the run depends on; a file with others is refused.
    every : the seconds between two writes.
    after : called after each write.
    """

    def __init__(
        self,
        path: str | Path | None = None,
        identity: Mapping[str, Any] = {},
        every: float = 10.0,
        after: Callable[[], None] = lambda: None,
    ) -> None:
        self.path = None if path is None else Path(path)
        self.identity = {"format": FORMAT, **identity}
        self.every, self.after = every, after
        self._written = time.monotonic()

    def restore(self, template: Callable[[], Any]) -> Any | None:
        """Return the state in the file, ``None`` where there is no file.

        Parameters
        ----------
        template : () -> a pytree of the state's structure; its leaves have ``dtype``, or are
            numbers. Their shapes may differ from those in the file: the number of draws grows.

        Raises
        ------
        InputError
            The file is damaged or belongs to another run.
        """
        if self.path is None or not self.path.exists():
            return None
        arrays, metadata = read_arrays(self.path)
        self._check(metadata)
        tree = template()
        named = named_leaves(tree)
        if named.keys() != arrays.keys():
            raise InputError(f"checkpoint {self.path} has other arrays than this run; remove it")
        leaves = [_as_in(leaf, arrays[name]) for name, leaf in named.items()]
        return jax.tree.unflatten(jax.tree.structure(tree), leaves)

    def keep(self, state: Callable[[], Any]) -> None:
        """Write ``state()``, if the last write is long enough ago."""
        if time.monotonic() - self._written >= self.every:
            self.write(state)

    def write(self, state: Callable[[], Any]) -> None:
        """Write ``state()``."""
        if self.path is None:
            return
        arrays = {
            name: np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf)
            for name, leaf in named_leaves(state()).items()
        }
        save_arrays(self.path, arrays, {"identity": json.dumps(self.identity)})
        self._written = time.monotonic()
        self.after()

    def remove(self) -> None:
        """Delete the file, because its run is complete."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)

    def _check(self, metadata: Mapping[str, str]) -> None:
        identity = json.loads(metadata.get("identity", "{}"))
        for name in self.identity | identity:
            in_file, here = identity.get(name), self.identity.get(name)
            if in_file != here:
                short = max(len(str(in_file)), len(str(here))) < _LONG
                raise InputError(
                    f"checkpoint {self.path} belongs to another run: its {name} is "
                    + (f"{in_file}, not {here}" if short else "another")
                    + "; repeat that run, or remove the file"
                )


def identity_of(
    provenance: Mapping[str, Any], arrays: Mapping[str, np.ndarray | jax.Array]
) -> dict[str, str]:
    """Return what a run depends on, by name: its provenance as JSON, and a hash of its data."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        digest.update(name.encode() + np.asarray(arrays[name]).tobytes())
    as_json = {name: json.dumps(value) for name, value in provenance.items()}
    return {**as_json, "data": digest.hexdigest()[:16]}


def _as_in(leaf: Any, array: np.ndarray) -> Any:
    """Return a leaf of a state from its array in the file; ``leaf`` is the template's."""
    if _is_key(leaf):
        return jax.random.wrap_key_data(jnp.asarray(array))
    return array.item() if isinstance(leaf, int | float) else array


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(getattr(leaf, "dtype", int), jax.dtypes.prng_key)
