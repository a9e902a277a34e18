"""Named arrays and words about them in one safetensors file."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from safetensors import safe_open
from safetensors.numpy import save_file
from studies.common.output import replacing


def save_arrays(
    path: Path, arrays: Mapping[str, np.ndarray], words: Mapping[str, str] = {}
) -> None:
    """Write the file, whole or not at all."""
    ordered = {name: np.asarray(array, order="C") for name, array in arrays.items()}
    with replacing(path) as temporary:
        save_file(ordered, temporary, metadata=dict(words))


def read_arrays(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Return the arrays and the words."""
    with safe_open(path, framework="numpy") as file:
        return {name: file.get_tensor(name) for name in file.keys()}, file.metadata() or {}  # noqa: SIM118
