"""A run's state on disk, from which a run that was killed goes on.

A state is a pytree of arrays. It is written every few seconds, whole or not at all, together with
what the run is of: model, data, options and seed. Nothing of the clock enters the state, so a
resumed run gives the draws of an uninterrupted one, bit for bit.
"""

from __future__ import annotations

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

FORMAT = "1"  # of the states; a file of another format is refused
_LONG = 60  # characters of a value that a message leaves out


class Checkpoint:
    """The file that a run's state is kept in.

    Parameters
    ----------
    path : a safetensors file; ``None`` keeps nothing.
    identity : what the run is of, by name: a file with another identity is refused.
    every : seconds between two writes.
    """

    def __init__(
        self,
        path: str | Path | None = None,
        identity: Mapping[str, str] = {},
        every: float = 10.0,
    ) -> None:
        self.path = None if path is None else Path(path)
        self.identity = {"format": FORMAT, **identity}
        self.every = every
        self._written = time.monotonic()

    def restore(self, template: Callable[[], Any]) -> Any | None:
        """The state kept, ``None`` where there is none.

        Parameters
        ----------
        template : () -> a pytree of the state's structure; its leaves have ``dtype``. Their shapes
            may differ from the kept ones, because draws become more.

        Raises
        ------
        InputError
            The file is damaged or belongs to another run.
        """
        if self.path is None or not self.path.exists():
            return None
        arrays, metadata = read_arrays(self.path)
        self._check(metadata)
        wanted = template()
        named = named_leaves(wanted)
        if named.keys() != arrays.keys():
            raise InputError(f"checkpoint {self.path} has other arrays than this run; remove it")
        leaves = [_leaf(arrays[name], leaf.dtype) for name, leaf in named.items()]
        return jax.tree.unflatten(jax.tree.structure(wanted), leaves)

    def keep(self, state: Callable[[], Any]) -> None:
        """Write ``state()``, if the last write is long enough ago."""
        if self.path is None or time.monotonic() - self._written < self.every:
            return
        arrays = {name: _array(leaf) for name, leaf in named_leaves(state()).items()}
        save_arrays(self.path, arrays, {"identity": json.dumps(self.identity)})
        self._written = time.monotonic()

    def remove(self) -> None:
        """Delete the file: its run is over."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)

    def _check(self, metadata: Mapping[str, str]) -> None:
        kept = json.loads(metadata.get("identity", "{}"))
        for name in self.identity | kept:
            was, now = kept.get(name), self.identity.get(name)
            if was != now:
                short = max(len(str(was)), len(str(now))) < _LONG
                raise InputError(
                    f"checkpoint {self.path} belongs to another run: its {name} is "
                    + (f"{was}, not {now}" if short else "another")
                    + "; repeat that run, or remove the file"
                )


def _is_key(dtype: Any) -> bool:
    return jnp.issubdtype(dtype, jax.dtypes.prng_key)


def _array(leaf: Any) -> np.ndarray:
    is_key = isinstance(leaf, jax.Array) and _is_key(leaf.dtype)
    return np.asarray(jax.random.key_data(leaf) if is_key else leaf)


def _leaf(array: np.ndarray, dtype: Any) -> Any:
    return jax.random.wrap_key_data(jnp.asarray(array)) if _is_key(dtype) else array
