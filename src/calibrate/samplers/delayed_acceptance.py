r"""Delayed acceptance: proposals by a cheap posterior's own sampler, decided by FEM.

Let :math:`\pi^*(z) \propto p(z)\,L^*(z)` be the posterior with the cheap forward map and
:math:`\pi(z) \propto p(z)\,L(z)` FEM's. A few No-U-Turn transitions, with fixed step size and
metric, lead from :math:`z` to :math:`z'`. Each is reversible with respect to :math:`\pi^*`, and so
is their composition with itself: :math:`\pi^*(z)\,q(z, z') = \pi^*(z')\,q(z', z)`. As a proposal
for :math:`\pi` it is therefore accepted with probability

.. math:: \alpha(z, z') = \min\!\left(1, \frac{\pi(z')\,q(z', z)}{\pi(z)\,q(z, z')}\right)
          = \min\!\left(1, \frac{w(z')}{w(z)}\right), \qquad w = \frac{L}{L^*}

which takes one FEM solve a proposal and leaves FEM's posterior invariant, however wrong the cheap
map is: a wrong one only lowers the acceptance rate. This is the second stage of Christen and Fox
(2005); a first stage of several transitions is the surrogate transition method of Liu (2001,
Sec. 9.4.3) and the subchains of Lykkegaard et al. (2023).

Where the cheap posterior has lighter tails than FEM's, :math:`w` has no bound and chains stick
there. So the cheap likelihood is raised to a power below 1, :math:`\pi^* \propto p\,L^{*\beta}` and
:math:`w = L / L^{*\beta}`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from calibrate.samplers import transport
from calibrate.samplers.chains import Chains, compile_chains, join
from calibrate.samplers.density import Density, tempered
from calibrate.samplers.nuts import BLACKJAX_NUTS, BlackJAXNUTSOptions
from calibrate.samplers.protocol import ChainOptions, Context, Draws, Sampler, in_rounds
from calibrate.statistical_model import Data
from emulator.core.display import counting
from emulator.core.errors import InputError, SolverError


@dataclass(frozen=True)
class DelayedAcceptanceOptions(ChainOptions):
    """Length of a run.

    warmup : the number of adapting iterations of the cheap sampler.
    draws : the number of draws of a round, each decided by FEM.
    transitions : the number of transitions of the cheap sampler between two FEM solves.
    power : the power of the cheap likelihood in proposals, in (0, 1]. At 0.8 a perfect map keeps
        three quarters of its effective draws in 5 dimensions and half in 17; a poor one gains.
    discarded : the number of first draws of each chain that are dropped: chains start from the
        cheap posterior.
    target_accept : the acceptance rate in (0, 1) that the cheap sampler's step size adapts to.
    """

    draws: int = 250
    rounds: int = 4
    transitions: int = 4
    power: float = 0.8
    discarded: int = 20
    target_accept: float = 0.85

    label: ClassVar[str] = "delayed acceptance"
    shares: ClassVar[tuple[str, ...]] = ("target_accept",)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 < self.power <= 1.0:
            raise InputError(f"{self.label}: power is {self.power}; give one in (0, 1]")

    def cheap(self) -> BlackJAXNUTSOptions:
        """Return options of the cheap sampler; its pilot run is as long as its warm-up."""
        return BlackJAXNUTSOptions(
            warmup=self.warmup,
            draws=self.warmup,
            chains=self.chains,
            rounds=1,
            r_hat=2.0,
            ess=0.0,
            start=self.start,
            target_accept=self.target_accept,
        )


class _Position(NamedTuple):
    """The current positions of the chains; arrays (chains, ...)."""

    states: Any  # the cheap sampler's state of each chain
    z: Any
    cheap_lp: Any
    log_w: Any
    means: Any  # FEM's data without noise, by the observation's name


class _State(NamedTuple):
    """The state from which a killed run continues."""

    map_: transport.StandardMap
    position: _Position
    count: Any  # number of draws so far, with discarded ones
    solves: Any  # number of FEM solves so far, with those of starts and discarded draws
    draws: Draws


_STATISTICS = {
    "acceptance_rate": float,
    "accepted": bool,
    "fem_solves": int,
    "log_w": float,
    "lp": float,
    "n_steps": int,
    "diverging": bool,
}


class DelayedAcceptance(Sampler):
    """The sampler whose proposals come from the cheap posterior and are decided by FEM."""

    solves_fem: ClassVar[bool] = True

    def sample(
        self, density: Density, data: Data, options: DelayedAcceptanceOptions, context: Context
    ) -> Draws:
        """Draw from FEM's posterior in rounds, until the chains agree.

        The attribute ``fem_solves`` counts all solves; the statistic counts those of each draw.

        Raises
        ------
        InputError
            There is no FEM likelihood in ``context``.
        SolverError
            FEM converged at none of a chain's first proposals.
        """
        with counting(desc=self.name, total=0, disable=not context.progress, unit="draw") as bar:
            run = _Run(density, data, options, context, bar)
            draws = in_rounds(run.draw, options)
        return draws._replace(attributes={"fem_solves": run.solves})


class _Run:
    """Running chains."""

    def __init__(
        self,
        density: Density,
        data: Data,
        options: DelayedAcceptanceOptions,
        context: Context,
        bar: tqdm,
    ) -> None:
        self.density, self.data, self.options, self.bar = density, data, options, bar
        self.checkpoint = context.checkpoint
        if context.fem is None:
            raise InputError(f"{options.label}: there is no FEM likelihood to decide by")
        self.fem = context.fem
        self.wide = tempered(density, options.power)
        self.programs = compile_chains(BLACKJAX_NUTS, self.wide, options.cheap())
        start_key, self.key = jax.random.split(jax.random.key(context.seed))
        state = self.checkpoint.restore(self._template) or self._begin(start_key)
        self.map_, self.position = state.map_, state.position
        self.count, self.solves = int(state.count), int(state.solves)
        self.parts = [state.draws]
        bar.update(self.count)

    def draw(self, total: int) -> Draws:
        """Return the first ``total`` draws of each chain after the discarded ones."""
        discarded = self.options.discarded
        last = self.bar.total = discarded + total
        while self.count < last:
            draws = self._step()
            self.count += 1
            if self.count > discarded:
                self.parts.append(draws)
            elif self.count == discarded and not np.isfinite(self.position.log_w).all():
                raise SolverError(
                    f"FEM converged at none of a chain's first {self.count + 1} proposals: the "
                    "cheap map leads to where FEM has no solution"
                )
            self.bar.update()
            self.checkpoint.keep(self._state)
        return jax.tree.map(lambda array: array[:, :total], join(self.parts))

    def _begin(self, key: jax.Array) -> _State:
        """Start chains at draws of the cheap posterior.

        This part has no checkpoint, because it solves no FEM: a killed run repeats it.
        """
        cheap = Chains(BLACKJAX_NUTS, self.wide, self.data, self.options.cheap(), Context())
        cheap.begin(key)
        self.map_ = cheap.map_
        proposal, _ = self._propose(cheap.states)
        every = np.full(len(proposal.z), True)
        log_w, means = self._by_fem(proposal.z, every, self._no_means((len(every),)))
        position = proposal._replace(log_w=log_w, means=means)
        return _State(self.map_, position, 0, len(proposal.z), self._no_draws())

    def _step(self) -> Draws:
        """Return one draw of each chain, (chains, 1)."""
        current = self.position
        proposal, cheap = self._propose(current.states)
        is_new = (proposal.z != current.z).any(axis=1)
        self.solves += int(is_new.sum())
        log_w, means = self._by_fem(proposal.z, is_new, current.means)
        log_w = np.where(is_new, log_w, current.log_w)
        # Where FEM fails the weight is 0: never accepted, and left at the first chance.
        with np.errstate(invalid="ignore", over="ignore"):
            probability = np.nan_to_num(np.exp(np.minimum(log_w - current.log_w, 0.0)), nan=0.0)
        key = jax.random.fold_in(self.key, self.count)
        accepted = np.asarray(jax.random.uniform(key, probability.shape)) < probability
        self.position = _choose(accepted, proposal._replace(log_w=log_w, means=means), current)
        statistics = {
            "acceptance_rate": probability,
            "accepted": accepted & is_new,
            "fem_solves": is_new.astype(int),
            "log_w": self.position.log_w,
            "lp": self.position.cheap_lp + self.position.log_w,
            "n_steps": cheap["n_steps"].sum(axis=1),
            "diverging": cheap["diverging"].any(axis=1),
        }
        draws = Draws(self.position.z, statistics, means=self.position.means)
        return jax.tree.map(lambda array: array[:, None], draws)

    def _propose(self, states: Any) -> tuple[_Position, Mapping[str, np.ndarray]]:
        """Return the cheap sampler's proposal without weights, and its statistics.

        The statistics are (chains, transitions).
        """
        transitions = self.options.transitions
        states, draws = self.programs.advance(states, self.data, self.map_, transitions)
        position = _Position(states, draws.z[:, -1], draws.statistics["lp"][:, -1], None, None)
        return position, draws.statistics

    def _by_fem(
        self, z: np.ndarray, solved: np.ndarray, means: Mapping[str, np.ndarray]
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Solve FEM at the ``solved`` points of z (chains, p).

        Return FEM's log likelihood less the tempered one (chains,), ``-inf`` where FEM fails or is
        not solved, and FEM's data without noise, there as in ``means``.
        """
        named = jax.tree.map(np.asarray, self.density.constrain(jnp.asarray(z)))
        log_w, new_means = np.full(len(z), -np.inf), {n: np.array(m) for n, m in means.items()}
        for k in np.flatnonzero(solved):
            likelihoods = self.fem({name: values[k] for name, values in named.items()}, self.data)
            ratio = likelihoods.fem - self.options.power * likelihoods.cheap
            log_w[k] = ratio if np.isfinite(ratio) else -np.inf
            for name, mean in likelihoods.means.items():
                new_means[name][k] = mean
        return log_w, new_means

    def _no_means(self, shape: tuple[int, ...]) -> dict[str, np.ndarray]:
        shapes = self.fem.model.observe.shapes
        return {name: np.full((*shape, *of), np.nan) for name, of in shapes.items()}

    def _no_draws(self) -> Draws:
        chains = self.options.chains
        statistics: dict[str, Any] = {
            name: np.zeros((chains, 0), kind) for name, kind in _STATISTICS.items()
        }
        z = np.zeros((chains, 0, self.density.dimension))
        return Draws(z, statistics, means=self._no_means((chains, 0)))

    def _state(self) -> _State:
        return _State(self.map_, self.position, self.count, self.solves, join(self.parts))

    def _template(self) -> _State:
        map_ = transport.standard_identity(self.density.dimension)
        states, _ = self.programs.shapes(self.options.chains, self.data, map_)
        number = np.zeros(())
        position = _Position(states, number, number, number, self._no_means(()))
        count = np.zeros((), int)
        return _State(map_, position, count, count, self._no_draws())


def _choose(accepted: np.ndarray, proposal: _Position, current: _Position) -> _Position:
    """Return the proposal of each chain where accepted; random keys advance either way."""
    states = tuple(
        new if yes else old._replace(rng_key=new.rng_key)
        for yes, new, old in zip(accepted, proposal.states, current.states, strict=True)
    )

    def chosen(new: np.ndarray, old: np.ndarray) -> np.ndarray:
        return np.where(accepted.reshape(-1, *(1,) * (new.ndim - 1)), new, old)

    return _Position(states, *jax.tree.map(chosen, proposal[1:], current[1:]))


DELAYED_ACCEPTANCE = DelayedAcceptance(
    "delayed_acceptance", DelayedAcceptanceOptions, tuple(_STATISTICS)
)
