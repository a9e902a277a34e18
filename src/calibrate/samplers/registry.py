"""The samplers by name. A new sampler is one file and one line here."""

from __future__ import annotations

from typing import Any

from calibrate.samplers.blackjax_nuts import BLACKJAX_NUTS
from calibrate.samplers.delayed_acceptance import DELAYED_ACCEPTANCE
from calibrate.samplers.laplace import LAPLACE
from calibrate.samplers.mclmc import MCLMC
from calibrate.samplers.nuts import NUTS
from calibrate.samplers.protocol import Sampler
from calibrate.samplers.smc import SMC
from emulator.errors import InputError

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
    if name not in SAMPLERS:
        raise InputError(f"sampler '{name}' is unknown; known: {', '.join(SAMPLERS)}")
    return SAMPLERS[name]


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
