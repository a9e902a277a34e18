"""Measurement noise, one kind a file; the kinds are listed in :data:`NOISES`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

from calibrate.noise.correlated import CorrelatedNoise
from calibrate.noise.gaussian import GaussianNoise
from calibrate.noise.protocol import Noise, Sites, information_about_means
from calibrate.noise.student_t import StudentTNoise
from emulator.core import schema
from emulator.core.errors import InputError

NOISES: dict[str, type[Noise]] = {
    kind.kind: kind for kind in (GaussianNoise, StudentTNoise, CorrelatedNoise)
}

_MEDIAN = 0.6745  # of a half-normal of scale 1

__all__ = [
    "NOISES",
    "CorrelatedNoise",
    "GaussianNoise",
    "Noise",
    "Sites",
    "StudentTNoise",
    "information_about_means",
    "noise_of",
    "parse_noise",
    "typical",
    "usage_of",
]


def noise_of(description: float | Mapping[str, Any]) -> Noise:
    """Return the noise of a run: Gaussian of a known sd, or a kind with its options.

    :class:`InputError` for a kind or an option that is unknown, missing or cannot be.
    """
    if not isinstance(description, Mapping):
        description = {"kind": GaussianNoise.kind, "sd": description}
    return schema.restore(NOISES, description, "noise")


def typical(noise: Noise) -> Noise:
    """Return the noise with each scale that is inferred at the median of its half-normal prior."""
    known: dict[str, Any] = {}
    for scale in noise.scales:
        if scale.known is None and scale.prior_scale is not None:
            value, prior = scale.options
            known |= {value: _MEDIAN * scale.prior_scale, prior: None}
    return replace(noise, **known)  # type: ignore[type-var]


def usage_of(kind: type[Noise]) -> str:
    """Return the word of a kind and its options on the command line, for help and errors."""
    options = (field.name for field in fields(kind) if field.name != "sites")  # type: ignore[arg-type]
    return f"{kind.kind}:OPTION=VALUE,... of {', '.join(options)}"


def parse_noise(text: str) -> float | dict[str, Any]:
    """Return the description of ``0.2`` or ``student_t:dof=4,scale=0.2``, for :func:`noise_of`.

    :class:`InputError` for neither a number nor a kind with options that it takes.
    """
    kind, _, options = text.partition(":")
    if kind not in NOISES:
        try:
            return float(text)
        except ValueError as error:
            usage = "; ".join(usage_of(kind) for kind in NOISES.values())
            raise InputError(f"'{text}' is neither a number nor a noise; give {usage}") from error
    description: dict[str, Any] = {"kind": kind}
    for option in options.split(",") if options else ():
        name, equals, value = option.partition("=")
        if not equals:
            raise InputError(
                f"'{text}': '{option}' is not option=value; give {usage_of(NOISES[kind])}"
            )
        description[name] = _number(value)
    noise_of(description)  # refuses options that the kind does not take
    return description


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text
