"""Provenance of results: machine, versions of packages, distributions in words."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np
import numpyro.distributions as dist

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
    cpuinfo, processor = Path("/proc/cpuinfo"), ""
    if cpuinfo.is_file():
        lines = cpuinfo.read_text(encoding="utf-8").splitlines()
        names = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
        processor = next(names, "")
    return {
        "processor": processor or platform.processor() or "unknown",
        "cores": os.cpu_count(),
        "machine": platform.machine(),
        "accelerator": accelerator,
    }


def describe_distribution(distribution: dist.Distribution) -> str:
    """Return a distribution in words, e.g. ``LogUniform(low=50.0, high=100.0)``."""
    parts = {name: getattr(distribution, name, None) for name in distribution.arg_constraints}
    base = getattr(distribution, "base_dist", None)
    # The arguments of a named transform such as LogUniform describe it fully.
    named = isinstance(distribution, dist.TransformedDistribution) and parts
    if isinstance(base, dist.Distribution) and not named:
        parts["base"] = base
    words = [
        f"{name}={describe_distribution(v) if isinstance(v, dist.Distribution) else _plain(v)}"
        for name, v in parts.items()
    ]
    return f"{type(distribution).__name__}({', '.join(words)})"


def _plain(value: Any) -> str:
    return repr(np.asarray(value).tolist())
