"""Draws of a posterior as theta of another scene: which parameter takes its values from where."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import jax
import numpy as np

from calibrate.importance.proposals import key_from
from calibrate.measurements import Observations
from calibrate.posterior import Posterior
from calibrate.priors.wide import stated_prior, widened
from calibrate.project import read_posterior
from calibrate.project.results import MEMBERS
from calibrate.state_names import split
from calibrate.statistical_model.load_states import LoadStates, load_states
from emulator.core.errors import InputError
from emulator.mechanics.laws.law import law_identity
from emulator.scenes.forward_problem import ForwardProblem, directions_read
from emulator.scenes.tissue import effective_angles
from emulator.surrogates.protocol import ForwardMap

_BULK = "kappa"  # the parameter of compressible laws that an incompressible specimen has no use for


@dataclass(frozen=True, eq=False)
class Learned:
    """Draws of a tissue's parameters, and the bodies that they were learned on.

    scene : one of the bodies. draws : draws (s,) of what was inferred, by name.
    known : the parameters of the law that were not inferred, with their values.
    bodies : the forward map of each body, and theta (S, p) of its load states at the mean.
    source : where the draws are from, in words.
    """

    scene: ForwardProblem
    draws: Mapping[str, np.ndarray]
    known: Mapping[str, float]
    bodies: Sequence[tuple[ForwardMap, jax.Array]]
    source: str = "the posterior"

    @classmethod
    def of(cls, posterior: Posterior) -> Learned:
        """Return what one body's posterior has learned."""
        model, draws = posterior.model, posterior.draws()
        scene = model.forward.scene
        columns = zip(*model.states.entries, strict=True)
        entries = zip(scene.parameter_names, columns, strict=True)
        known = {name: column[0] for name, column in entries if isinstance(column[0], float)}
        known = {**scene.constants, **known}
        if getattr(model.full, "incompressible", False):
            known.pop(_BULK, None)  # nothing there depends on it
        means = {name: values.mean() for name, values in draws.items()}
        return cls(scene, draws, known, [(model.full, model.states.thetas(means))])

    @classmethod
    def of_population(cls, folder: str | Path) -> Learned:
        """Return what a population in ``folder`` says of a member that was not seen."""
        from calibrate.project.members import read_members  # a room

        plan, hierarchy = read_members(folder)
        members = [
            cls.of(read_posterior(Path(folder) / MEMBERS / name)[1]) for name in plan.members
        ]
        first = members[0]
        bodies = [body for member in members for body in member.bodies]
        return cls(first.scene, hierarchy.new_member(), first.known, bodies)

    def of_another_specimen(self, log_sd: float, rng: np.random.Generator) -> Learned:
        r"""Return what was learned of one specimen, as draws of another one of the same tissue.

        The stiffness of both scatters about the tissue's, so all moduli that were inferred are
        multiplied by one factor c,

        .. math:: \ln c \sim N(0, 2 s^2) .

        log_sd : the log-sd s of the stiffness between specimens.

        :class:`InputError` for a log-sd that is not positive, for a population, whose draws scatter
        already, or where no modulus was inferred.
        """
        if not 0.0 < log_sd < np.inf:
            raise InputError(f"scatter between specimens: log-sd {log_sd:g}; give one above 0")
        if len(self.bodies) > 1:
            raise InputError("another specimen: draws of a population scatter already")
        moduli = {q.name for q in self.scene.law.quantities if q.unit} & set(self.draws)
        if not moduli:
            raise InputError("another specimen: the posterior has no modulus that could scatter")
        count = len(next(iter(self.draws.values())))
        factor = np.exp(np.sqrt(2.0) * log_sd * rng.standard_normal(count))
        draws = {n: v * factor if n in moduli else v for n, v in self.draws.items()}
        source = f"{self.source}, for another specimen (stiffness with log-sd {log_sd:.2g} between)"
        return replace(self, draws=draws, source=source)


@dataclass(frozen=True, eq=False)
class Transfer:
    """Draws of a posterior as theta of another scene.

    scene : the other scene, its ranges wide enough for all draws.
    states : the source of each entry of theta in each load state.
    draws : a value (s,) of each of their unknowns.
    sources : the source of each parameter's values, in words.
    """

    scene: ForwardProblem
    states: LoadStates
    draws: Mapping[str, np.ndarray]
    sources: Mapping[str, str]


def made_of[P: ForwardProblem](scene: P, tissue: ForwardProblem) -> P:
    """Return ``scene`` of another tissue: of its law, with the law's parameters and constants.

    Parameters and constants of loads and supports stay, and so does a bulk modulus that both laws
    have.
    Directions that nothing reads any more are left out.

    :class:`InputError` where the law needs fibres or sheets and the scene has none.
    """
    law, before, after = tissue.law, set(scene.tissue_parameters), set(tissue.tissue_parameters)
    gone = before - ({_BULK} & after)
    constants = {name: v for name, v in tissue.constants.items() if name in after}
    constants |= {name: v for name, v in scene.constants.items() if name not in gone}
    parameters = (
        *(p for p in tissue.parameters if p.name in after and p.name not in constants),
        *(p for p in scene.parameters if p.name not in before),
    )
    read = directions_read(law, getattr(scene, "loads", ()))
    changes: dict[str, Any] = {
        kind: None if reader is None else getattr(scene, kind) for kind, reader in read.items()
    }
    if hasattr(scene, "viscosity"):
        changes["viscosity"] = getattr(tissue, "viscosity", None)
    changes["angles"] = effective_angles(scene.angles, changes["fibres"], changes["sheets"])
    other = replace(
        cast(Any, scene), law=law, parameters=parameters, constants=constants, origin={}, **changes
    )
    return cast(P, other)


def transfer(
    learned: Learned,
    scene: ForwardProblem,
    observe: Observations,
    known: Mapping[str, float],
    count: int,
    rng: np.random.Generator,
) -> Transfer:
    """Return ``count`` draws of what was learned, all if there are fewer, as theta of ``scene``.

    A parameter of the law has the posterior's draws, or the value that was known there. Another one
    that ``known`` does not name is drawn from its prior in the scene, or else from its range.

    :class:`InputError` where the laws differ, where the scene holds constant what the posterior
    infers, or for a known name that is no parameter, or one of the posterior's.
    """
    before, inferred = learned.scene, learned.draws
    if law_identity(before.law) != law_identity(scene.law):
        raise InputError(
            f"scene '{scene.name}' has law {scene.law.name}, and the posterior is of "
            f"{before.law.name}: give a scene of the same law"
        )
    if other := set(before.tissue_parameters) ^ set(scene.tissue_parameters):
        raise InputError(
            f"scene '{scene.name}' or the posterior has no {', '.join(sorted(other))}: give a "
            "scene with the posterior's [viscosity]"
        )
    material = [name for name in before.parameter_names if name in before.tissue_parameters]
    for name in material:
        if name in inferred and name in scene.constants:
            raise InputError(
                f"scene '{scene.name}' holds {name} at {scene.constants[name]:g}, and the "
                "posterior infers it: make it one of the scene's parameters"
            )
        if name in inferred and name in known:
            raise InputError(f"{name} is known as {known[name]:g}, and the posterior infers it")
    sources = dict.fromkeys(known, "given")
    fixed, values = learned.known, dict(known)
    for name in set(scene.parameter_names) & set(scene.tissue_parameters) - set(inferred):
        if name in fixed and name not in values:
            values[name], sources[name] = fixed[name], f"{fixed[name]:g}, as for the posterior"
    size = len(next(iter(inferred.values())))
    rows = np.sort(rng.choice(size, size=min(count, size), replace=False))
    stated = stated_prior(scene)
    if stated is not None:
        scene = widened(scene, stated)
    prior = {n: d for n, d in (stated.prior(scene) if stated else {}).items() if n not in values}
    states, priors = load_states(scene, observe.states, prior, values)
    draws = dict[str, np.ndarray]()
    for name in states.unknowns:
        base = split(name)[0]
        if name in inferred and base in material:
            draws[name], sources[base] = inferred[name][rows], learned.source
        else:
            sample = priors[name].sample(key_from(rng), (len(rows),))
            draws[name], sources[name] = np.asarray(sample), _prior_in_words(scene, base)
    wide = _wide_enough(scene, states, draws)
    return Transfer(wide, states, draws, sources)


def _prior_in_words(scene: ForwardProblem, name: str) -> str:
    """Return what a scene says of a parameter: its stated prior, or else its range."""
    (parameter,) = (p for p in scene.parameters if p.name == name)
    if (prior := parameter.prior) is not None:
        return f"its prior in the scene, median {prior.median:.4g}, log sd {prior.log_sd:.2g}"
    return f"its range in the scene, {parameter.low:g} to {parameter.high:g}"


def _wide_enough(
    scene: ForwardProblem, states: LoadStates, draws: Mapping[str, np.ndarray]
) -> ForwardProblem:
    """Return ``scene`` with ranges that hold its own and theta of all draws."""
    thetas = np.asarray(states.thetas(draws)).reshape(-1, len(scene.parameters))
    parameters = tuple(
        replace(
            p,
            low=min(p.low, float(column.min())),
            high=max(p.high, float(column.max())),
            prior=None,
        )
        for p, column in zip(scene.parameters, thetas.T, strict=True)
    )
    return cast(ForwardProblem, replace(cast(Any, scene), parameters=parameters))
