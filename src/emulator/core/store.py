"""Weights and checkpoints on disk: safetensors for arrays, JSON next to them; never pickle.

A file is written whole or not at all: to a temporary name first, then renamed.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

import jax
import numpy as np
from filelock import FileLock, Timeout
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from emulator.core.errors import InputError

NESTING = 100  # levels of tables and lists; files that this package reads have fewer than ten


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yield a temporary file next to ``path``, which it replaces if nothing raises.

    Folders are made as needed. The temporary name keeps the suffix, from which some writers take
    the format.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}.", suffix=path.suffix)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o644)  # mkstemp makes files that only their owner may read
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_atomically(path: str | Path, content: bytes | memoryview) -> None:
    """Replace ``path`` by ``content``; on failure the old file stays, and OSError names it."""
    try:
        with replacing(path) as temporary, temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error


def write_netcdf(path: str | Path, content: Any) -> None:
    """Write a Dataset or DataTree of xarray as netCDF.

    It is made in memory first: a disk that is full would end the process inside HDF5. In a worker
    of Dask, xarray would ask the cluster for a lock, which what is in memory does not need.
    """
    dask = sys.modules.get("dask")
    with nullcontext() if dask is None else dask.config.set(scheduler="synchronous"):
        made = content.to_netcdf(engine="h5netcdf")
    write_atomically(path, made)


def to_json(content: Any) -> str:
    """Return ``content`` as indented, valid JSON: numbers that are not finite become null."""
    return json.dumps(_finite(content), indent=2, allow_nan=False)


def _finite(content: Any) -> Any:
    if isinstance(content, Mapping):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, np.ndarray):
        content = content.tolist()
    if isinstance(content, list | tuple):
        return [_finite(value) for value in content]
    if isinstance(content, float) and not math.isfinite(content):
        return None
    return content


def write_json(path: str | Path, content: Any) -> None:
    """Write ``content`` as :func:`to_json` formats it."""
    write_atomically(path, (to_json(content) + "\n").encode())


def check_folder(path: str | Path) -> Path:
    """Return ``path``; raise :class:`InputError` unless it can be a writable folder."""
    path = Path(path)
    existing = path
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    if not existing.is_dir() or not os.access(existing, os.W_OK):
        raise InputError(f"cannot write to {path}: {existing} is not a folder one may write to")
    return path


@contextmanager
def exclusive(path: str | Path, what: str) -> Iterator[Path]:
    """Yield ``path``, locked against every other process that locks it.

    Its folder is made, and goes again if it stays empty.

    Raises :class:`InputError`: another ``what`` is writing there.
    """
    path = Path(path)
    check_folder(path.parent)
    new = not path.parent.exists()
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(path.parent / f".{path.name}.lock")
    try:
        lock.acquire(blocking=False)
    except Timeout:
        raise InputError(f"{path}: another {what} is writing to it; wait until it ends") from None
    try:
        yield path
    finally:
        # Removed while locked: another process that has opened it already finds, once it has the
        # lock, that the file has no name any more, and opens a new one (filelock 4.2 and later).
        with suppress(OSError):  # Windows removes no open file
            Path(lock.lock_file).unlink()
        lock.release()
        if new:
            with suppress(OSError):  # raises where the folder is not empty
                path.parent.rmdir()


def parse_text(parser: Callable[[str], Any], text: str) -> Any:
    """Return what a parser of TOML or JSON makes of ``text``.

    Raises ValueError, as the parser does, also where tables and lists are nested too deep.
    """
    too_deep = f"tables or lists are nested deeper than {NESTING} levels"
    try:
        content = parser(text)
    except RecursionError:
        raise ValueError(too_deep) from None
    level = [content]
    for _ in range(NESTING):
        level = [
            value
            for container in level
            if isinstance(container, dict | list)
            for value in (container.values() if isinstance(container, dict) else container)
        ]
    if level:
        raise ValueError(too_deep)
    return content


def read_json(path: str | Path) -> Any:
    """Return the content of a JSON file; :class:`InputError` when missing or malformed."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path} does not exist")
    try:
        return parse_text(json.loads, path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{path} is not valid JSON: {error}") from error


def named_leaves(tree: Any) -> dict[str, Any]:
    """Return the leaves of a pytree by their path, e.g. ``rounds/0/edge/kernel``."""
    named = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        words = jax.tree_util.keystr(path, simple=True, separator="/").split("/")
        named["/".join(word for word in words if word != "value")] = leaf  # flax wraps each weight
    return named


def save_arrays(
    path: str | Path, arrays: Mapping[str, Any], metadata: Mapping[str, str] = {}
) -> str:
    """Write named arrays; return the SHA-256 of the file."""
    ordered = {name: np.asarray(array, order="C") for name, array in arrays.items()}
    content = save(ordered, metadata=dict(metadata))
    write_atomically(path, content)
    return hashlib.sha256(content).hexdigest()


def read_arrays(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Return arrays and metadata of a safetensors file; :class:`InputError` if unreadable."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"weights file {path} does not exist")
    try:
        with safe_open(path, framework="numpy") as file:
            arrays = {name: file.get_tensor(name) for name in list(file.keys())}
            return arrays, file.metadata() or {}
    except (SafetensorError, OSError, ValueError) as error:
        raise InputError(
            f"weights file {path} is truncated or not a safetensors file ({error})"
        ) from error


def fill_tree[Tree](template: Tree, arrays: Mapping[str, np.ndarray], what: str) -> Tree:
    """Return ``template`` with leaves from ``arrays`` (:func:`named_leaves`), of equal shapes.

    what : where the arrays come from, for the error message.
    """
    named = named_leaves(template)
    for name, leaf in named.items():
        if name not in arrays:
            raise InputError(f"{what}: array '{name}' is missing")
        if arrays[name].shape != np.shape(leaf):
            raise InputError(
                f"{what}: array '{name}' has shape {arrays[name].shape}; expected {np.shape(leaf)}"
            )
    leaves = [arrays[name] for name in named]
    return jax.tree_util.tree_unflatten(jax.tree_util.tree_structure(template), leaves)


def inside(arrays: Mapping[str, np.ndarray], folder: str) -> dict[str, np.ndarray]:
    """Return the arrays whose names begin with ``folder/``, keyed by the rest of the name."""
    start = f"{folder}/"
    return {name.removeprefix(start): a for name, a in arrays.items() if name.startswith(start)}


def narrow(array: Any) -> np.ndarray:
    """Return the array in float32 where that loses nothing, which halves the file."""
    wide = np.asarray(array)
    if wide.dtype != np.float64 or np.abs(wide).max(initial=0.0) > np.finfo(np.float32).max:
        return wide
    narrow = wide.astype(np.float32)
    return narrow if np.array_equal(narrow.astype(np.float64), wide) else wide
