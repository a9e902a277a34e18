"""The one description of a calibration: scene, data, model, and sampler.

A :class:`Run` is an experiment file, ``run.json``, and what the command line's options say. Its
fields are the keys of both files and the names of the options; its docstring describes the keys in
the JSON Schema (:mod:`calibrate.project.experiment`) and the options in the help
(:mod:`calibrate.cli.run_words`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from calibrate.measurements import DISPLACEMENT, Observations
from calibrate.measurements.usual_noise import usual_noise
from calibrate.model_error.kinds import read_systematic
from calibrate.noise import Noise, noise_of
from calibrate.state_names import split
from calibrate.statistical_model import at_sites
from emulator.core.engine import THREADS, check_engine
from emulator.core.errors import InputError
from emulator.surrogates import registry

if TYPE_CHECKING:
    from calibrate.samplers import Sampler
    from emulator.scenes.forward_problem import ForwardProblem

SYNTHETIC = "synthetic"
"""The word for data that FEM makes."""


@dataclass(frozen=True)
class Run:
    """The description of a calibration.

    scene : a scene's name or file.
    root : the folder of the published data.
    data : a file, files by load state (:func:`calibrate.measurements.data.read_measurements`), or
        ``synthetic``: FEM at ``truth`` plus noise.
    truth : parameters of synthetic data by name, ``parameter@state`` in one of several load states
        (:mod:`calibrate.state_names`).
    known : parameters that are not inferred, by the same names; the parameters that the data's
        files know are added. Synthetic data has them too, unless ``truth`` says otherwise.
    observe : observations of synthetic data, joined by ``+``, e.g. ``landmarks:24+volume``; each
        kind of ``calibrate.measurements.OBSERVATIONS`` says which words ask for it. They are made
        in every load state that ``truth`` and ``known`` name; ``volume@diastole`` in one.
    prior : ``box``, the name of a population of ``calibrate.priors.population.POPULATIONS``, or the
        fields of a :class:`calibrate.priors.Population`.
    bounded : parameters whose range ends where nature does, as a share ends at 1; where a posterior
        ends at the range of another one, data and not the range should end it.
    noise : standard deviation by the observation's name, in its unit, or a kind of
        :data:`calibrate.noise.NOISES` with its options, ``{"kind": "student_t", "dof": 4, "scale":
        0.2}``. A bare number belongs to a single observation, or to the displacements. An
        observation that is not named has its kind's default, or 3 % of what is observed of the
        body where that is less.
    noise_scale : scale of the half-normal prior of a standard deviation that is inferred, by the
        same names; synthetic data then still has the standard deviation of ``noise``.
    systematic : errors that several numbers share, by a name of their own, each a kind of
        :data:`calibrate.model_error.kinds.SYSTEMATIC_ERRORS` with its options, e.g.
        ``{"camera": {"kind": "rigid_motion", "of": "displacement", "shift": 2.0, "turn": 1.0}}``;
        synthetic data has none.
    check_scale : refuse data that is far from every prediction
        (:mod:`calibrate.measurements.magnitude`).
    forward : a name of :data:`emulator.surrogates.registry.FORWARD_MAPS`.
    emulator : shipped name or folder of the emulator that the map is built from, or the kind of
        one shipped for the scene, ``series`` or ``physics``; by default its graph network.
    forward_options : the map's options by name, e.g. ``{"fem_runs": 60}``.
    load_steps : load steps in which every FEM solve follows the loading path from rest; 1 solves
        at the full load.
    engine : what does many solves: ``threads``, ``processes:N``, or ``dask:ADDRESS``, a scheduler.
    sampler : a name of :data:`calibrate.samplers.SAMPLERS`.
    sampler_options : the sampler's options by name, e.g. ``{"target_accept": 0.95}``.
    warmup : iterations of each chain that adapt the sampler and are not kept.
    draws : iterations of each chain and round that are kept.
    chains : number of independent chains.
    seed : seed of synthetic data, of the design of FEM runs and of the sampler.
    """

    scene: str
    root: str | None = None
    data: str | dict[str, str] = SYNTHETIC
    truth: dict[str, float] = field(default_factory=dict)
    known: dict[str, float] = field(default_factory=dict)
    observe: str = "nodes:20"
    prior: dict[str, Any] | str = "box"
    bounded: tuple[str, ...] = ()
    noise: Mapping[str, float | dict[str, Any]] | float = field(default_factory=dict)
    noise_scale: Mapping[str, float] | float = field(default_factory=dict)
    systematic: Mapping[str, dict[str, Any]] = field(default_factory=dict)
    check_scale: bool = True
    forward: str = "emulator"
    emulator: str | None = None
    forward_options: dict[str, Any] = field(default_factory=dict)
    load_steps: int = 1
    engine: str = THREADS
    sampler: str = "auto"
    sampler_options: dict[str, Any] = field(default_factory=dict)
    warmup: int = 500
    draws: int = 1000
    chains: int = 4
    seed: int = 0

    def __post_init__(self) -> None:
        registry.full_options(self.forward, self.forward_options)
        if self.engine != THREADS:
            check_engine(self.engine)
        registry.check_words(self.forward, emulator=self.emulator)
        least = dict.fromkeys(("warmup", "draws", "chains", "load_steps"), 1)
        for name in (*least, "seed"):
            if (value := getattr(self, name)) < least.get(name, 0):
                raise InputError(f"{name} is {value}; it must be {least.get(name, 0)} or more")
        if self.truth and self.data != SYNTHETIC:
            raise InputError(f"truth has no effect beside data file {self.data}; leave one out")
        for name, description in self.systematic.items():
            read_systematic(name, description)

    @property
    def is_synthetic(self) -> bool:
        """Whether FEM makes the data."""
        return self.data == SYNTHETIC

    def sampling(self) -> tuple[Sampler, Any]:
        """Return the sampler and its options; :class:`InputError` for an unknown one of either."""
        from calibrate.samplers import find_sampler, options_from  # ArviZ takes a second

        sampler = find_sampler(self.sampler)
        length = {"warmup": self.warmup, "draws": self.draws, "chains": self.chains}
        return sampler, options_from(sampler, self.sampler_options, **length)

    def named(self, observe: Observations, scene: ForwardProblem | None = None) -> Run:
        """Return the run with every noise by name; defaults fit the size of ``scene``."""
        scales = _by_name(self.noise_scale, observe, "noise-scale")
        noise = _by_name(self.noise, observe, "noise")
        expanded = observe.expand(noise, "noise")
        defaults = {
            split(name)[0]: usual_noise(part, scene).upper_sd
            for name, part in observe.parts.items()
            if name not in expanded
        }
        return replace(self, noise={**defaults, **noise}, noise_scale=scales)

    def noises(self, observe: Observations) -> dict[str, Noise]:
        """Return the noise of each observation in the likelihood."""
        run = self.named(observe)
        assert isinstance(run.noise, Mapping)
        assert isinstance(run.noise_scale, Mapping)
        scales = observe.expand(run.noise_scale, "noise-scale")
        noises: dict[str, Noise] = {}
        for name, (source, description) in observe.expand(run.noise, "noise").items():
            scale_source, scale = scales.get(name, (source, None))
            # An entry that names one load state gives that state a noise of its own.
            has_own_noise = name in (source, scale_source)
            try:
                noise = noise_of(description)
                noise = noise if scale is None else noise.inferred(scale)
            except InputError as error:
                raise InputError(f"{name} ({observe.parts[name].unit}): {error}") from error
            noises[name if has_own_noise else source] = noise
        return noises

    def synthetic_noise(self, observe: Observations) -> dict[str, Noise]:
        """Return the noise of each observation of synthetic data."""
        noises = replace(self, noise_scale={}).noises(observe)
        by_name = {name: noise for name, (_, noise) in observe.expand(noises, "noise").items()}
        return at_sites(by_name, observe)


def _by_name[T](
    values: Mapping[str, T] | float, observe: Observations, what: str
) -> dict[str, T | float]:
    """Return values by name; a bare one is a single observation's or the displacements'.

    A name without its load state stands for every state.
    """
    if not isinstance(values, Mapping):
        bases = observe.bases
        if len(bases) > 1 and DISPLACEMENT not in bases:
            raise InputError(f"{what}: give one for each of {', '.join(bases)}, by name")
        return {DISPLACEMENT if len(bases) > 1 else bases[0]: values}
    observe.expand(values, what)
    return dict(values)
