"""A sampler has a name and options, and draws from a density.

Samplers that are Markov chains give a :class:`Kernel` and options that extend
:class:`ChainOptions`, and leave the rest to :class:`~calibrate.samplers.chains.ChainSampler`; a
sampler of another kind (weighted points, an approximation) implements :meth:`Sampler.sample`
itself.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar, NamedTuple

import jax

from calibrate.samplers.diagnostics import ENOUGH_ESS, RUN_UNTIL_R_HAT, converged
from emulator.core.checkpoint import Checkpoint
from emulator.core.errors import InputError

Statistics = Mapping[str, Any]
"""Statistics by ArviZ's names: ``diverging``, ``acceptance_rate``, ``n_steps``, ``lp``, ..."""


class Draws(NamedTuple):
    """Draws ``z`` (chains, draws, p) in unconstrained coordinates; statistics (chains, draws).

    attributes : facts of the whole run, plain JSON, e.g. ``log_evidence``.
    """

    z: Any
    statistics: Statistics
    attributes: Mapping[str, Any] = {}


class Context(NamedTuple):
    """The inputs of a run besides density, data and options.

    seed : the seed of all random numbers.
    progress : whether a progress bar is shown.
    checkpoint : the file that the run's state is written to, and restored from after a kill.
    """

    seed: int = 0
    progress: bool = False
    checkpoint: Checkpoint = Checkpoint()


@dataclass(frozen=True)
class Sampler(ABC):
    """A way to draw from a posterior.

    name : the name in the registry and on the command line.
    options : the frozen dataclass of its settings; its defaults are the sampler's.
    """

    name: str
    options: type[Any]

    @abstractmethod
    def sample(self, density: Any, data: Any, options: Any, context: Context) -> Draws:
        """Draw from ``density`` given ``data``."""


def in_rounds(draw: Callable[[int], Draws], options: Any) -> Draws:
    """Return ``draw`` of a total number of draws, which rises until chains or populations agree.

    options : options with ``draws``, ``rounds``, ``r_hat`` and ``ess``.
    """
    for rounds in range(1, options.rounds + 1):
        draws = draw(rounds * options.draws)
        if converged(draws.z, options.r_hat, options.ess):
            break
    return draws


class Kernel(NamedTuple):
    """A Markov transition, written for one chain.

    init : the function of a random key, a position (p,) and further arguments that returns the
        first state: a pytree of arrays with everything the next step needs, its random key
        included.
    step : the function of a state and further arguments that returns the next state, its position
        (p,), and statistics by name, each ().

    Further arguments are passed on to the log density and not interpreted.
    """

    init: Callable[..., Any]
    step: Callable[..., tuple[Any, jax.Array, Statistics]]


@dataclass(frozen=True)
class Options:
    """Settings of a sampler: whole numbers of 1 or more, and ``shares`` in (0, 1)."""

    label: ClassVar[str]
    shares: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.type in (int, "int") and value < 1:
                raise InputError(f"{self.label}: {field.name} is {value}; it must be 1 or more")
            if field.name in self.shares and not 0.0 < value < 1.0:
                raise InputError(f"{self.label}: {field.name} is {value}; give one in (0, 1)")
            if field.name == "r_hat" and not value > 1.0:
                raise InputError(f"{self.label}: r_hat is {value}; it must be above 1")
            if field.name == "ess" and not value >= 0.0:
                raise InputError(f"{self.label}: ess is {value}; it must be 0 or more")


@dataclass(frozen=True)
class ChainOptions(Options):
    """Length of a run.

    warmup : the number of adapting iterations, whose draws are dropped.
    draws : the number of draws of a round; the pilot is shorter.
    chains : the number of independent chains.
    rounds : the largest number of rounds; another one begins while R-hat or ESS miss their limits.
    r_hat, ess : the largest R-hat, and smallest bulk and tail ESS of any parameter, to stop at.
    """

    warmup: int = 500
    draws: int = 1000
    chains: int = 4
    rounds: int = 8
    r_hat: float = RUN_UNTIL_R_HAT
    ess: float = ENOUGH_ESS

    label: ClassVar[str] = "chains"
