"""What a sampler provides.

A sampler draws from a :class:`~calibrate.samplers.density.Density` and knows its own name, options
and statistics; :mod:`calibrate.samplers.registry` finds it by name. Samplers that are Markov chains
give a kernel and leave the rest to :class:`~calibrate.samplers.run.ChainSampler`; a sampler of
another kind (particles, an approximation) implements :meth:`Sampler.sample` itself.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

import jax

from calibrate.samplers.checkpoint import Checkpoint
from calibrate.samplers.density import Density
from calibrate.statistical_model import Data, FEMLikelihood

Statistics = Mapping[str, Any]
"""Statistics by ArviZ's names: ``diverging``, ``acceptance_rate``, ``n_steps``, ``lp``, ..."""


class Draws(NamedTuple):
    """Draws ``z`` (chains, draws, p) in unconstrained coordinates; statistics (chains, draws).

    attributes : facts of the whole run, plain JSON, e.g. ``log_evidence``.
    means : data without noise at the draws, (chains, draws, *shape) by the observation's name, of
        a sampler that does not draw from the model's own posterior but from FEM's.
    """

    z: Any
    statistics: Statistics
    attributes: Mapping[str, Any] = {}
    means: Mapping[str, Any] | None = None


class Context(NamedTuple):
    """What a run is given besides its density.

    progress : whether to show it.
    checkpoint : where the run's state is kept, and found again after a kill.
    fem : FEM's log likelihood, for samplers with FEM in a second stage.
    """

    progress: bool = False
    checkpoint: Checkpoint = Checkpoint()
    fem: FEMLikelihood | None = None


class Sampler(Protocol):
    """A way to draw from a posterior.

    name : as in the registry and on the command line.
    options : frozen dataclass of its settings; its defaults are the sampler's.
    statistics : names of the statistics that come with every draw.
    solves_fem : whether it needs FEM's likelihood (:attr:`Context.fem`).
    """

    @property
    def name(self) -> str: ...  # noqa: D102

    @property
    def options(self) -> type[Any]: ...  # noqa: D102

    @property
    def statistics(self) -> tuple[str, ...]: ...  # noqa: D102

    @property
    def solves_fem(self) -> bool: ...  # noqa: D102

    def sample(
        self,
        density: Density,
        data: Data,
        options: Any,
        seed: int,
        context: Context = Context(),
    ) -> Draws:
        """Draw from ``density`` given ``data``."""
        ...


class Kernel(NamedTuple):
    """A Markov transition, written for one chain.

    init : (rng_key, position (p,), *arguments) -> state. The state is a pytree of arrays that holds
        everything the next step needs, its random key included.
    step : (state, *arguments) -> (state, position (p,), statistics by name, each ()).

    ``arguments`` are passed on to the log density and not interpreted.
    """

    init: Callable[..., Any]
    step: Callable[..., tuple[Any, jax.Array, Statistics]]
