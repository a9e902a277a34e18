"""Noise on the command line: words ``NAME=VALUE`` by the observation's name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from emulator.core.errors import InputError

NoiseWord = float | dict[str, Any]


def noise_words(words: Sequence[str]) -> dict[str, NoiseWord] | float:
    """``--noise``: numbers, or kinds of noise with their options, by the observation's name.

    A single bare number is returned as it is: which observation it belongs to depends on the data.
    Beside named values, a bare number is the displacements'.
    """
    from calibrate.noise import NOISES, parse_noise

    for word in words:
        if word.partition(":")[0] in NOISES:
            raise InputError(f"--noise: '{word}' needs a name, as in displacement={word}")
    if len(words) == 1 and "=" not in words[0]:
        return _number(words[0], "--noise")
    return _by_name(words, "--noise", parse_noise)


def noise_scale_words(words: Sequence[str]) -> dict[str, float] | float:
    """``--noise-scale``: numbers as in :func:`noise_words`."""
    if len(words) == 1 and "=" not in words[0]:
        return _number(words[0], "--noise-scale")
    return _by_name(words, "--noise-scale", float)


def discrepancy_words(words: Sequence[str]) -> dict[str, dict[str, float]]:
    """``--discrepancy``: scale and correlation length, ``SCALE:LENGTH``, by name."""
    return _by_name(words, "--discrepancy", _discrepancy)


def _discrepancy(text: str) -> dict[str, float]:
    scale, length = map(float, text.split(":"))
    return {"scale": scale, "length": length}


def _by_name[T](words: Sequence[str], option: str, read: Callable[[str], T]) -> dict[str, T]:
    found: dict[str, T] = {}
    for word in words:
        name, equals, text = word.partition("=")
        if not equals:
            name, text = "displacement", word
        if name in found and not equals:
            raise InputError(f"{option}: '{word}' needs a name, as in volume={word}")
        if name in found:
            raise InputError(f"{option}: '{name}' is given twice; once is enough")
        try:
            found[name] = read(text)
        except InputError as error:
            raise InputError(f"{option}: {error}") from error
        except ValueError as error:
            right = {"--discrepancy": "displacement=0.5:20"}.get(option, "volume=1.0")
            raise InputError(f"{option}: '{word}' is wrong; write it as in {right}") from error
    return found


def _number(word: str, option: str) -> float:
    try:
        return float(word)
    except ValueError as error:
        raise InputError(f"{option}: '{word}' is not a number") from error
