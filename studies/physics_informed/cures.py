r"""Cures of training by the energy, each for the same seconds of processor, on the clamped beam.

Adam on the energy stalls because soft modes cost little energy. All cures know forces and tangents
of the network's own predictions, and no FEM solution. Written for nine places of the unit square,
3 x 3, with a tangent K each, taken at the prediction there and shifted until it is positive
definite:

energy
    Adam on the mean potential of 16 theta.
loads rise
    The same, with the loads rising over the first third of the time.
one tangent
    The gradient of :math:`\tfrac1b \sum e \cdot u` with :math:`e = K^{-1} r(u)` held, of the middle
    tangent; e is cut at a twentieth of the network's scale (a trust region). Loads rise.
nearest of nine
    The same with the tangent of the place that theta is drawn in.
modes by projection
    Coefficients of four theta a place are reduced Newton steps
    :math:`c \leftarrow c - \alpha (M^T K M)^{-1} M^T r(Mc)` on the energy in the span of the modes
    M, guarded; modes learn from :math:`e \otimes c`, the branch from c.
Gauss-Newton at last
    After half of the time of *nearest of nine* the modes are frozen, and the last layer of the
    branch is solved for by damped Gauss-Newton steps on the energy of 72 theta.
L-BFGS at last
    The same, but the whole branch descends the energy of 72 theta by L-BFGS.

The limit of what modes and branch can hold is what recipe ``physics`` reaches with the same
network.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from studies.common.output import Case, save

import emulator as em
from calibrate.figures.drawing import pyplot
from emulator.error.comparison import quantiles
from emulator.fem import Runs
from emulator.surrogates import Emulator
from emulator.surrogates.network.graph import augment
from emulator.surrogates.network.part import Network, fresh
from emulator.training.modal import ARCHITECTURE
from emulator.training.step import in_branch, predictor

SIDE, BATCH, FIXED = 3, 16, 4
RATE, TRUST, RISE, REFRESH = 1e-3, 0.05, 1.0 / 3.0, 50
_SHIFT = 1e-4  # of the mean diagonal, tenfold until a tangent is positive definite
_SHOWN = 12  # errors of a way over its time

Weights = nnx.State


@dataclass(frozen=True, eq=False)
class Bench:
    """A network on a body, and the body's mechanics at its predictions."""

    simulator: em.Simulator
    network: Network

    @cached_property
    def predict(self) -> Callable[..., jax.Array]:
        """``predict(weights, thetas)``: (b, n, 3) mm."""
        return predictor(Emulator(self.simulator.scene, network=self.network))

    @property
    def size(self) -> float:
        """Scale of the network's output, mm."""
        return float(self.network.scale[0])

    def theta(self, x: jax.Array) -> jax.Array:
        """From positions in the unit square."""
        return self.simulator.scene.from_unit(x)

    @cached_property
    def potentials(self) -> Callable[..., jax.Array]:
        """Of fields (b, n, 3) at theta (b, p) and a load level."""
        of = lambda u, t, level: self.simulator.system.potential(u, t, level)[0]  # noqa: E731
        return jax.vmap(of, (0, 0, None))

    @cached_property
    def residuals(self) -> Callable[..., jax.Array]:
        """(b, f)."""
        return jax.vmap(self.simulator.system.residual, (0, 0, None))

    @cached_property
    def middles(self) -> np.ndarray:
        """Of the nine places, (9, 2)."""
        at = (np.arange(SIDE) + 0.5) / SIDE
        return np.stack(np.meshgrid(at, at, indexing="ij"), axis=-1).reshape(-1, 2)

    def draw(self, key: jax.Array, place: jax.Array, count: int) -> jax.Array:
        """Positions (count, 2) in a place."""
        from_middle = jax.random.uniform(key, (count, 2)) - 0.5
        return jnp.asarray(self.middles)[place] + from_middle / SIDE

    def tangent(self, u: jax.Array, x: np.ndarray, level: float) -> tuple[np.ndarray, np.ndarray]:
        """K (f, f) at ``u``, shifted until it is positive definite, and its inverse; float32."""
        system = self.simulator.system
        values = system.tangent(u, self.theta(jnp.asarray(x)), level)
        K = system.pattern.matrix(values).toarray()
        shift = 0.0
        while True:
            try:
                np.linalg.cholesky(K + shift * np.eye(len(K)))
            except np.linalg.LinAlgError:
                shift = max(10.0 * shift, _SHIFT * np.trace(K) / len(K))
                continue
            K[np.diag_indices(len(K))] += shift
            return K.astype(np.float32), np.linalg.inv(K).astype(np.float32)


def bench(scene: em.Scene, seed: int) -> Bench:
    """An untrained network, whose scale is a tenth of the body's length."""
    scale = np.full(3, 0.1 * np.ptp(scene.mesh.nodes, axis=0).max())
    network = fresh(scene, augment(scene), ARCHITECTURE, scale, seed)
    return Bench(em.Simulator(scene), network)


class Way:
    """A cure under way: its weights, and a step of it. One place after the other."""

    rises, tangents = True, 0

    def __init__(self, bench: Bench) -> None:
        self.bench, self.number = bench, 0
        self.optimiser = optax.adam(1.0)
        self.weights: Weights = jax.tree.map(jnp.copy, bench.network.weights)
        self.state = self.optimiser.init(self.weights)
        self.K, self.inverse = {}, {}
        self._descend = jax.jit(jax.value_and_grad(self.loss, has_aux=True))

    def level(self, fraction: float) -> float:
        """Of the loads, at that fraction of the time."""
        return min(1.0, max(fraction / RISE, 0.02)) if self.rises else 1.0

    def place(self) -> int:
        """Whose turn it is."""
        return self.number % SIDE**2

    def step(self, fraction: float) -> None:
        """One step of Adam; a tangent is renewed now and then."""
        level, place = self.level(fraction), self.place()
        kept = (SIDE**2 // 2 if self.tangents == 1 else place) if self.tangents else None
        if kept is not None and (kept not in self.inverse or self.number % REFRESH == 0):
            x = self.bench.middles[kept]
            u = self.bench.predict(self.weights, self.bench.theta(jnp.asarray(x))[None])[0]
            self.K[kept], self.inverse[kept] = self.bench.tangent(u, x, level)
        key = jax.random.fold_in(jax.random.key(0), self.number)
        given = self.given(kept, place)
        (_, told), gradient = self._descend(self.weights, key, place, level, given)
        rate = RATE * min(1.0, (self.number + 1) / 100) * 0.5 * (1.0 + np.cos(np.pi * fraction))
        updates, self.state = self.optimiser.update(gradient, self.state)
        updates = jax.tree.map(lambda d: (rate * d).astype(d.dtype), updates)
        self.weights = optax.apply_updates(self.weights, updates)
        self.learn(place, told)
        self.number += 1

    def given(self, kept: int | None, place: int) -> Any:
        """What a step takes besides."""
        del place
        return None if kept is None else self.inverse[kept]

    def learn(self, place: int, told: Any) -> None:
        """What a step leaves besides."""

    def loss(self, weights: Weights, key: jax.Array, place: Any, level: Any, given: Any) -> Any:
        """What Adam descends."""
        del place, given
        theta = self.bench.theta(jax.random.uniform(key, (BATCH, 2)))
        energy = self.bench.potentials(self.bench.predict(weights, theta), theta, level)
        return jnp.mean(energy), None


class Energy(Way):
    """Adam on the energy, at the whole load."""

    rises = False


class OneTangent(Way):
    """Adam on the energy's gradient beside one tangent."""

    tangents = 1

    def loss(self, weights: Weights, key: jax.Array, place: Any, level: Any, given: Any) -> Any:
        """Whose gradient is that of e . u."""
        drawn = jax.random.uniform(key, (BATCH, 2))
        x = drawn if self.tangents == 1 else self.bench.draw(key, place, BATCH)
        theta = self.bench.theta(x)
        u = self.bench.predict(weights, theta)
        e = self.cut(self.bench.residuals(u, theta, level) @ given)
        free = jax.vmap(self.bench.simulator.system.restrict)(u)
        return jnp.mean(jnp.sum(jax.lax.stop_gradient(e) * free, axis=1)), None

    def cut(self, e: jax.Array) -> jax.Array:
        """Steps (b, f), none longer than a twentieth of the scale; none that is not finite."""
        rms = jnp.sqrt(jnp.mean(e**2, axis=1, keepdims=True))
        e = e * jnp.minimum(1.0, TRUST * self.bench.size / rms)
        return jnp.where(jnp.isfinite(e), e, 0.0)


class NearestTangent(OneTangent):
    """The same beside the tangent of theta's own place."""

    tangents = SIDE**2


class Projection(OneTangent):
    """Coefficients by reduced Newton steps on the energy, modes from what is left."""

    tangents = SIDE**2

    def __init__(self, bench: Bench) -> None:
        super().__init__(bench)
        keys = jax.random.split(jax.random.key(1), SIDE**2)
        self.x = [bench.draw(key, place, FIXED) for place, key in enumerate(keys)]
        self.c = [jnp.zeros((FIXED, bench.network.architecture.modes)) for _ in keys]

    def given(self, kept: int | None, place: int) -> Any:
        """Tangent, inverse, theta, and their coefficients so far."""
        return self.K[kept], self.inverse[kept], self.x[place], self.c[place]

    def learn(self, place: int, told: Any) -> None:
        """The coefficients."""
        self.c[place] = told

    def loss(self, weights: Weights, key: jax.Array, place: Any, level: Any, given: Any) -> Any:
        """Of modes e . Mc with c held, of the branch its distance from c."""
        del key, place
        K, inverse, x, c = given
        system, theta = self.bench.simulator.system, self.bench.theta(x)
        decoder, modes = self.bench.network.prepare(weights)
        M = jax.vmap(system.restrict)(modes.astype(float) * self.bench.size)  # (r, f)
        held = jax.lax.stop_gradient(M)
        field = lambda c: jax.vmap(system.extend)(c @ held)  # noqa: E731
        G = (held.astype(K.dtype) @ K @ held.T.astype(K.dtype)).astype(float)
        factor = jax.scipy.linalg.cho_factor(G + 1e-6 * jnp.trace(G) / len(G) * jnp.eye(len(G)))
        for _ in range(2):
            step = self.residual_in(held, factor, field(c), theta, level)
            before = self.bench.potentials(field(c), theta, level)
            tried = [c + a * step for a in (1.0, 0.3, 0.1)]
            for t in tried[::-1]:  # the longest that lowers the energy
                lower = self.bench.potentials(field(t), theta, level) < before
                c = jnp.where(lower[:, None], t, c)
        e = self.cut(self.bench.residuals(field(c), theta, level) @ inverse)
        branch = decoder.coefficients(self.bench.network.normalise(x)).astype(float) - c
        misfit = jnp.mean(jnp.sum((branch @ G) * branch, axis=1)) / jnp.mean(jnp.diag(K))
        return jnp.mean(jnp.sum(e * (c @ M), axis=1)) + misfit, c

    def residual_in(
        self, M: jax.Array, factor: Any, u: jax.Array, theta: jax.Array, level: Any
    ) -> jax.Array:
        """The reduced Newton step (b, r)."""
        pulled = self.bench.residuals(u, theta, level) @ M.T
        return -jax.scipy.linalg.cho_solve(factor, pulled.T).T


class Finish:
    """Modes frozen after :class:`NearestTangent`; the branch on 8 theta a place."""

    def __init__(self, bench: Bench) -> None:
        self.first, self.bench = NearestTangent(bench), bench
        keys = jax.random.split(jax.random.key(2), SIDE**2)
        self.x = jnp.concatenate([bench.draw(key, p, 8) for p, key in enumerate(keys)])
        self.begun = False

    @property
    def weights(self) -> Weights:
        """Now."""
        return self.first.weights

    def step(self, fraction: float) -> None:
        """The first half is the other way's."""
        if fraction < 0.5:
            return self.first.step(2.0 * fraction)
        if not self.begun:
            decoder, modes = jax.jit(self.bench.network.prepare)(self.weights)
            self.begin(decoder, modes)
            self.begun = True
        self.last()
        return None

    def energy(self, decoder: Any, modes: jax.Array) -> jax.Array:
        """Mean potential of all theta."""
        theta = self.bench.theta(self.x)
        u = self.bench.network.decode(decoder, modes, self.x)
        u = jax.vmap(self.bench.simulator.scene.on_supports)(u, theta)
        return jnp.mean(self.bench.potentials(u, theta, 1.0))


class LBFGS(Finish):
    """The whole branch by L-BFGS."""

    def begin(self, decoder: Any, modes: jax.Array) -> None:
        """Set up."""
        definition, state = nnx.split(decoder)
        leaves, structure = jax.tree_util.tree_flatten_with_path(state)
        mine = [in_branch(path) for path, _ in leaves]
        fixed = [leaf for _, leaf in leaves]

        def joined(branch: list[jax.Array]) -> Any:
            new = iter(branch)
            return jax.tree.unflatten(
                structure, [next(new) if m else f for m, f in zip(mine, fixed, strict=True)]
            )

        def value(branch: list[jax.Array]) -> jax.Array:
            return self.energy(nnx.merge(definition, joined(branch)), modes).astype(jnp.float32)

        solver = optax.lbfgs(memory_size=20)
        self._branch = [leaf for m, leaf in zip(mine, fixed, strict=True) if m]
        self._state, self._joined = solver.init(self._branch), joined
        both = optax.value_and_grad_from_state(value)

        @jax.jit
        def move(branch: Any, state: Any) -> Any:
            v, g = both(branch, state=state)
            updates, state = solver.update(g, state, branch, value=v, grad=g, value_fn=value)
            return optax.apply_updates(branch, updates), state

        self._move = move

    def last(self) -> None:
        """One iteration."""
        self._branch, self._state = self._move(self._branch, self._state)
        network = nnx.merge(self.bench.network.definition, self.weights)
        nnx.update(network.decoder, self._joined(self._branch))
        self.first.weights = nnx.state(network)


class GaussNewton(Finish):
    """The branch's last layer by damped Gauss-Newton steps."""

    def begin(self, decoder: Any, modes: jax.Array) -> None:
        """Features of all theta, and products of the modes in each place's tangent."""
        system = self.bench.simulator.system
        M = jax.vmap(system.restrict)(modes.astype(float) * self.bench.size)
        hidden = decoder.branch.hidden(self.bench.network.normalise(self.x)).astype(float)
        hidden = jnp.concatenate([hidden, jnp.ones((len(hidden), 1))], axis=1)
        theta, G = self.bench.theta(self.x), []
        for x in self.bench.middles:
            u = self.bench.predict(self.weights, self.bench.theta(jnp.asarray(x))[None])[0]
            K = self.bench.tangent(u, x, 1.0)[0]
            G.append(np.asarray(M) @ K.astype(float) @ np.asarray(M).T)
        h, r = hidden.shape[1], len(M)
        normal = np.zeros((h * r, h * r))
        for place in range(SIDE**2):
            mine = np.asarray(hidden)[8 * place : 8 * place + 8]
            normal += np.kron(mine.T @ mine, G[place])
        normal += 1e-9 * np.trace(normal) / len(normal) * np.eye(h * r)
        self._factor = jax.scipy.linalg.cho_factor(jnp.asarray(normal))

        @jax.jit
        def pull(weights: Weights) -> tuple[jax.Array, jax.Array]:
            u = self.bench.predict(weights, theta)
            forces = self.bench.residuals(u, theta, 1.0) @ M.T
            step = jax.scipy.linalg.cho_solve(self._factor, (hidden.T @ forces).ravel())
            return jnp.mean(self.bench.potentials(u, theta, 1.0)), -step.reshape(h, r)

        self._pull, self._length = pull, 1.0

    def last(self) -> None:
        """One step, half as long where the energy does not fall."""
        before, step = self._pull(self.weights)
        for _ in range(6):
            network = nnx.merge(self.bench.network.definition, self.weights)
            layer = network.decoder.branch.layers[-1]
            moved = (self._length * step).astype(jnp.float32)
            layer.kernel.set_value(layer.kernel.get_value() + moved[:-1])
            layer.bias.set_value(layer.bias.get_value() + moved[-1])
            weights = nnx.state(network)
            if float(self._pull(weights)[0]) < float(before):
                self.first.weights, self._length = weights, min(1.0, 2.0 * self._length)
                return
            self._length /= 2.0


WAYS: dict[str, Callable[[Bench], Any]] = {
    "energy": Energy,
    "energy, loads rise": Way,
    "one tangent": OneTangent,
    "nearest of nine": NearestTangent,
    "modes by projection": Projection,
    "Gauss-Newton at last": GaussNewton,
    "L-BFGS at last": LBFGS,
}


def cure(name: str, scene: em.Scene, known: Runs, seconds: float, seed: int) -> Case:
    """The errors of one way over its time, of the processor and compilation included."""
    one = bench(scene, seed)
    predict = jax.jit(one.predict)

    def errors(weights: Weights) -> dict[str, float]:
        off = jnp.linalg.norm(predict(weights, known.theta) - known.displacement, axis=-1)
        return quantiles(off)

    began, looking, curve = time.process_time(), 0.0, []
    way = WAYS[name](one)
    while True:
        spent = time.process_time() - began - looking
        if spent >= seconds * (len(curve) + 1) / _SHOWN:
            before = time.process_time()
            curve.append({"seconds": round(spent, 1), "err_u": errors(way.weights)})
            looking += time.process_time() - before
        if spent >= seconds:
            break
        way.step(spent / seconds)
    return {"cure": name, "fem_solutions": 0, "seconds": seconds, "curve": curve}


def draw_cures(cases: Sequence[Case], path: Path) -> None:
    """Median error of each cure over its time."""
    if not cases:
        return
    plt = pyplot()
    figure, axes = plt.subplots(figsize=(6.4, 4.0), layout="constrained")
    for case in cases:
        curve = case["curve"]
        x = [point["seconds"] for point in curve]
        axes.plot(x, [point["err_u"]["median"] for point in curve], "o-", ms=3, label=case["cure"])
    axes.set(yscale="log", xlabel="seconds of processor", ylabel="median err_u, mm")
    axes.set_title("The energy's descent and its cures: clamped beam")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="0.92")
    axes.legend(frameon=False, fontsize=8)
    save(figure, path)
