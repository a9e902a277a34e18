"""The samplers by name. A new sampler is one file and one line here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

from calibrate.samplers.blackjax_nuts import BLACKJAX_NUTS
from calibrate.samplers.delayed_acceptance import DELAYED_ACCEPTANCE
from calibrate.samplers.laplace import LAPLACE
from calibrate.samplers.mclmc import MCLMC
from calibrate.samplers.nuts import NUTS
from calibrate.samplers.protocol import Sampler
from calibrate.samplers.smc import SMC
from emulator.core.errors import InputError, look_up

_ALL: tuple[Sampler, ...] = (
    NUTS,
    BLACKJAX_NUTS,
    MCLMC,
    DELAYED_ACCEPTANCE,
    SMC,
    LAPLACE,
)
SAMPLERS: dict[str, Sampler] = {sampler.name: sampler for sampler in _ALL}


def find_sampler(name: str) -> Sampler:
    """The sampler of that name; :class:`InputError` names the known ones."""
    return look_up(SAMPLERS, name, "sampler")


def check_options(sampler: Sampler, options: Any | None) -> Any:
    """``options``, the sampler's defaults for ``None``; :class:`InputError` for another's."""
    if options is None:
        return sampler.options()
    if type(options) is not sampler.options:
        raise InputError(
            f"sampler '{sampler.name}' takes {sampler.options.__name__}, "
            f"not {type(options).__name__}"
        )
    return options


def options_from(
    sampler: Sampler, given: Mapping[str, Any], *, warmup: int, draws: int, chains: int
) -> Any:
    """Options of a run of this length, with those of ``given`` by name.

    Raises
    ------
    InputError
        A name that the sampler has no option of, or a value of another type.
    """
    options = sampler.options.sized(warmup=warmup, draws=draws, chains=chains)
    known = {field.name: getattr(options, field.name) for field in fields(options)}
    for name, value in given.items():
        if name not in known:
            raise InputError(
                f"sampler '{sampler.name}' has no option '{name}'; it has {', '.join(known)}"
            )
        wanted = (int, float) if isinstance(known[name], float) else type(known[name])
        if isinstance(value, bool) or not isinstance(value, wanted):
            raise InputError(
                f"sampler '{sampler.name}': {name} is {value!r}; give one like {known[name]!r}"
            )
    return replace(options, **given)
