"""The kinds of noise there are: the one list of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from calibrate.noise.gaussian import GaussianNoise
from calibrate.noise.protocol import Noise
from emulator.errors import InputError

KINDS: dict[str, type[Noise]] = {kind.kind: kind for kind in (GaussianNoise,)}


def noise_from_json(description: Mapping[str, Any]) -> Noise:
    """The noise that :meth:`Noise.to_json` described."""
    kind = description.get("kind")
    if kind not in KINDS:
        raise InputError(f"noise kind '{kind}' is unknown; known: {', '.join(KINDS)}")
    return KINDS[kind].from_json(description)
