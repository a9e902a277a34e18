"""The released networks: weights, inputs of the processor, statistics of theta.

A clone of the release has the weights of a model as a pickle. Unpickling runs what the file says,
so this reader admits arrays of numbers and dictionaries and refuses all else. The same arrays in
an ``.npz`` file, ``<model>/trained/weights.npz``, are read as well.
"""

from __future__ import annotations

import io
import pickle  # arrays and dictionaries only, see _Arrays
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from emulator.core.errors import InputError
from emulator.released.scenes import folder_of, read_array, units

_PICKLE = "emulationResults/trainedParameters/{model}/trainedNetworkParams.pkl"
_FIRST = "params/"
_DEPTH = 8  # largest nesting of dictionaries; the released ones have four


class ReleasedNetwork(NamedTuple):
    """A released network.

    weights : float32 arrays by the names of the release, such as ``FlaxMLP_0/Dense_0/kernel``.
    node_features (N, d), edge_features (E, 4), senders, receivers (E,) : the augmented graph.
    mean, sd : (p,) of theta, in the model's own units and stored order.
    """

    weights: Mapping[str, np.ndarray]
    node_features: np.ndarray
    edge_features: np.ndarray
    senders: np.ndarray
    receivers: np.ndarray
    mean: np.ndarray
    sd: np.ndarray


def read_network(root: str | Path, model: str) -> ReleasedNetwork:
    """Read the network of ``model``, from a clone of the release or from its folder ``data``.

    Raises
    ------
    InputError
        A file is missing, damaged, does not fit the others, or holds more than arrays.
    """
    units(model)
    weights = _weights(root, model)

    def geometry(name: str, shape: tuple[int | None, ...]) -> np.ndarray:
        return read_array(root, model, f"geometryData/{name}.npy", shape)

    nodes = geometry("augmented-node-features", (None, None))
    edges = geometry("edge-features", (None, 4))
    pairs = geometry("sparse-topology", (len(edges), None)).astype(np.int64)
    layers = geometry("node-layer-labels", (len(nodes),))
    real = len(geometry("reference-coords", (None, 3)))
    where = f"published data: the graph of {model}"
    if (layers[:real] != 0).any() or (layers[real:] == 0).any():
        raise InputError(f"{where} does not begin with the {real} nodes of its mesh")
    if pairs.min() < 0 or pairs.max() >= len(nodes):
        raise InputError(f"{where} joins nodes there are none of")
    statistics = "normalisationStatistics/theta-{}.npy"
    mean, sd = (read_array(root, model, statistics.format(n), (None,)) for n in ("mean", "std"))
    if mean.shape != sd.shape or not (sd > 0.0).all():
        raise InputError(f"published data: mean and sd of theta of {model} do not belong together")
    return ReleasedNetwork(weights, nodes, edges, pairs[:, 0], pairs[:, -1], mean, sd)


def _weights(root: str | Path, model: str) -> dict[str, np.ndarray]:
    """Read weights by name, from the first file that exists."""
    plain = folder_of(root, model) / "trained" / "weights.npz"
    pickled = [Path(base) / _PICKLE.format(model=model) for base in (root, Path(root).parent)]
    path = next((path for path in (plain, *pickled) if path.is_file()), None)
    if path is None:
        raise InputError(
            f"published data: no trained network of {model}: neither {plain} nor {pickled[0]} "
            f"exists; networks are released of TwistingBeam, Liver and LeftVentricle"
        )
    weights = _from_npz(path) if path == plain else _from_pickle(path)
    for name, array in weights.items():
        if array.dtype != np.float32 or not np.isfinite(array).all():
            raise InputError(f"{path}: array '{name}' is not of finite float32 numbers")
    return {name.removeprefix(_FIRST): array for name, array in weights.items()}


def _from_npz(path: Path) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (ValueError, EOFError, OSError) as error:
        raise InputError(f"{path} is not a readable .npz file of arrays") from error


def _from_pickle(path: Path) -> dict[str, np.ndarray]:
    try:
        return dict(_leaves(_Arrays(io.BytesIO(path.read_bytes())).load()))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except Exception as error:  # a damaged pickle may raise anything
        raise InputError(f"{path} is not a readable pickle") from error


def _leaves(tree: Any, names: tuple[str, ...] = ()) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the arrays of nested dictionaries, by their joined keys."""
    name = "/".join(names)
    if len(names) > _DEPTH:
        raise InputError(f"nests more than {_DEPTH} dictionaries, at '{name}'; it is not read")
    if isinstance(tree, np.ndarray) and tree.dtype.kind == "f":
        yield name, tree
    elif isinstance(tree, dict) and all(isinstance(key, str) for key in tree):
        for key, part in tree.items():
            yield from _leaves(part, (*names, key))
    else:
        what = type(tree).__name__
        raise InputError(f"holds a {what} at '{name}'; only arrays by name are read")


class _Arrays(pickle.Unpickler):
    """An unpickler that can make arrays of numbers and containers, and call nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        """Return what arrays are pickled with; :class:`InputError` for any other name."""
        if (module, name) not in _MAKERS:
            raise InputError(
                f"asks for {module}.{name}; a pickle of anything but arrays is not read"
            )
        return _MAKERS[module, name]


def _reconstruct(kind: type, shape: tuple[int, ...], code: bytes) -> np.ndarray:
    """Begin an array as NumPy does; its state, with shape and numbers, follows."""
    if kind is not np.ndarray or tuple(shape) != (0,) or code not in (b"b", "b"):
        raise InputError("makes something else of an array; it is not read")
    return np.ndarray((0,), np.int8)


def _frombuffer(
    buffer: bytes, dtype: np.dtype, shape: tuple[int, ...], order: Literal["C", "F"]
) -> np.ndarray:
    """Return an array as the newest pickles write it."""
    if not isinstance(buffer, bytes | bytearray) or np.dtype(dtype).kind not in "fiub":
        raise InputError("makes something else of an array; it is not read")
    return np.frombuffer(buffer, dtype=dtype).reshape(shape, order=order)


def _of_jax(make: Any, arguments: tuple, state: tuple, _aval: Any) -> np.ndarray:
    """Return a JAX array, which is pickled as a NumPy function, its arguments, and a state."""
    if make is not _reconstruct:
        raise InputError("makes something else of an array; it is not read")
    array = make(*arguments)
    array.__setstate__(state)
    return array


def _dictionary(content: Any) -> dict:
    """Return Flax's frozen dictionary, which is pickled as a plain one."""
    if not isinstance(content, dict):
        raise InputError("makes something else of a dictionary; it is not read")
    return content


def _latin1(text: str, encoding: str) -> bytes:
    """Return bytes as old pickles write them."""
    if encoding != "latin1":
        raise InputError(f"asks for the encoding {encoding}; it is not read")
    return text.encode("latin1")


_MAKERS: dict[tuple[str, str], Callable[..., Any]] = {
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
    ("numpy.core.multiarray", "_reconstruct"): _reconstruct,
    ("numpy._core.multiarray", "_reconstruct"): _reconstruct,
    ("numpy.core.numeric", "_frombuffer"): _frombuffer,
    ("numpy._core.numeric", "_frombuffer"): _frombuffer,
    ("_codecs", "encode"): _latin1,
    ("jax._src.array", "_reconstruct_array"): _of_jax,
    ("flax.core.frozen_dict", "FrozenDict"): _dictionary,
}
