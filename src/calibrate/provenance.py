"""Provenance of results: machine, versions of packages, commit."""

from __future__ import annotations

import json
import os
import platform
import subprocess
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax

PACKAGES = (
    "soft-tissue-calibrate",
    "jax",
    "jaxlib",
    "flax",
    "optax",
    "numpyro",
    "numpy",
    "scipy",
    "scikit-fem",
    "scikit-learn",
    "sparsax",
    "arviz",
)


def as_attributes(values: Mapping[str, Any]) -> dict[str, str | int | float]:
    """Return the attributes of a netCDF file: text and numbers as they are, all else as JSON."""
    return {
        name: value if isinstance(value, str | int | float) else json.dumps(value)
        for name, value in values.items()
    }


def versions() -> dict[str, str]:
    """Return the versions of this package and of those its numbers depend on."""
    return {name: version(name) for name in PACKAGES}


def hardware() -> dict[str, Any]:
    """Return processor, cores, and the accelerator if JAX uses one."""
    accelerator = None if jax.default_backend() == "cpu" else jax.devices()[0].device_kind
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "machine": platform.machine(),
        "accelerator": accelerator,
    }


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        for line in cpuinfo.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or "unknown"


def commit(folder: str | Path) -> str | None:
    """Return the commit at ``folder``, with ``+`` if files were changed; ``None`` without git."""
    try:
        words = ["git", "-C", str(folder), "describe", "--always", "--dirty=+", "--abbrev=12"]
        process = subprocess.run(words, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return process.stdout.strip()


def study_header(folder: str | Path, seed: int) -> dict[str, Any]:
    """Return the first entries of every study's results.json."""
    return {
        "hardware": hardware(),
        "versions": versions(),
        "commit": commit(folder),
        "seed": seed,
    }
