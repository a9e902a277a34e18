"""Samplers behind one protocol: ``protocol`` says what they give, ``registry`` finds them."""

from calibrate.samplers.chains import ChainSampler
from calibrate.samplers.delayed_acceptance import DelayedAcceptanceOptions
from calibrate.samplers.density import Density, density_of, named_draws
from calibrate.samplers.diagnostics import r_hat
from calibrate.samplers.laplace import LaplaceOptions
from calibrate.samplers.mclmc import MCLMCOptions
from calibrate.samplers.nuts import BlackJAXNUTSOptions, NUTSOptions
from calibrate.samplers.protocol import ChainOptions, Context, Draws, Kernel, Sampler
from calibrate.samplers.registry import SAMPLERS, check_options, find_sampler, options_from
from calibrate.samplers.smc import SMCOptions

__all__ = [
    "SAMPLERS",
    "BlackJAXNUTSOptions",
    "ChainOptions",
    "ChainSampler",
    "Context",
    "DelayedAcceptanceOptions",
    "Density",
    "Draws",
    "Kernel",
    "LaplaceOptions",
    "MCLMCOptions",
    "NUTSOptions",
    "SMCOptions",
    "Sampler",
    "check_options",
    "density_of",
    "find_sampler",
    "named_draws",
    "options_from",
    "r_hat",
]
