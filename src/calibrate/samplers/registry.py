"""The samplers by name. A new sampler is one file and one line here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from calibrate.samplers.delayed_acceptance import DELAYED_ACCEPTANCE
from calibrate.samplers.laplace import LAPLACE
from calibrate.samplers.mclmc import MCLMC
from calibrate.samplers.nuts import BLACKJAX_NUTS, NUTS
from calibrate.samplers.protocol import Sampler
from calibrate.samplers.smc import SMC
from emulator.core.errors import InputError, look_up
from emulator.core.schema import Source, parse, table_of

_ALL: tuple[Sampler, ...] = (NUTS, BLACKJAX_NUTS, MCLMC, DELAYED_ACCEPTANCE, SMC, LAPLACE)
SAMPLERS: dict[str, Sampler] = {sampler.name: sampler for sampler in _ALL}


def find_sampler(name: str) -> Sampler:
    """Return the sampler of that name; :class:`InputError` names the known ones."""
    return look_up(SAMPLERS, name, "sampler")


def check_options(sampler: Sampler, options: Any | None) -> Any:
    """Return ``options``, or the sampler's defaults for ``None``.

    Raises
    ------
    InputError
        The options are those of another sampler.
    """
    if options is None:
        return sampler.options()
    if type(options) is not sampler.options:
        raise InputError(
            f"sampler '{sampler.name}' takes {sampler.options.__name__}, "
            f"not {type(options).__name__}"
        )
    return options


def options_from(
    sampler: Sampler, values: Mapping[str, Any], *, warmup: int, draws: int, chains: int
) -> Any:
    """Return options of a run of this length, with ``values`` by name for the others.

    Raises
    ------
    InputError
        A name that the sampler has no option of, or a value of another type.
    """
    options = sampler.options.sized(warmup=warmup, draws=draws, chains=chains)
    source = Source(f"sampler '{sampler.name}'", dict(values), toml=False)
    parse(table_of(sampler.options), source)
    return replace(options, **values)
