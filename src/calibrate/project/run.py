"""What to calibrate and how: a :class:`Run` is plain JSON."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from calibrate.measurements import DISPLACEMENT, Observations
from calibrate.noise import Noise, noise_of, with_discrepancy
from calibrate.state_names import split
from calibrate.statistical_model import at_sites
from calibrate.statistical_model.shared_errors import shared_error
from emulator.core.errors import InputError
from emulator.surrogates import registry


@dataclass(frozen=True)
class Run:
    """What to calibrate and how.

    scene : a scene's name or file.
    root : the folder of the published data.
    data : a file, files by load state (:func:`calibrate.measurements.data.read_data`), or
        ``synthetic``: FEM at ``truth`` plus noise.
    truth : parameters of synthetic data by name, ``parameter@state`` in one of several load states
        (:mod:`calibrate.state_names`).
    known : parameters that are not inferred, by the same names; what the data's files know comes to
        them. They are those of synthetic data too, unless ``truth`` says otherwise.
    observe : observations of synthetic data, joined by ``+``, e.g. ``landmarks:24+volume``; each
        kind of ``calibrate.measurements.OBSERVATIONS`` says which words ask for it. They are made
        in every load state that ``truth`` and ``known`` name; ``volume@diastole`` in one.
    prior : ``box``, the name of a population of ``calibrate.priors.population.POPULATIONS``, or the
        fields of a :class:`calibrate.priors.Population`.
    noise : standard deviation by the observation's name, in its unit, or a kind of
        :data:`calibrate.noise.NOISES` with its options, ``{"kind": "student_t", "dof": 4, "scale":
        0.2}``. A bare number belongs to a single observation, or to the displacements. What is not
        named has its kind's default.
    noise_scale : the same for the scale of the prior of a standard deviation that is to be
        inferred; synthetic data then still has the one of ``noise``.
    discrepancy : discrepancy of the model (:mod:`calibrate.noise.discrepancy`) by the
        observation's name, e.g. ``{"scale": 0.5, "length": 20.0}``; synthetic data has none.
    systematic : errors that several numbers share, by a name of their own, each a kind of
        :data:`calibrate.statistical_model.shared_errors.SHARED_ERRORS` with its options, e.g.
        ``{"camera": {"kind": "rigid_motion", "of": "displacement", "shift": 2.0, "turn": 1.0}}``;
        synthetic data has none.
    check_scale : refuse data that is far from every prediction
    (:mod:`calibrate.measurements.magnitude`).
    forward : a name of :data:`emulator.surrogates.registry.FORWARD_MAPS`.
    emulator : shipped name or folder of the emulator that the map is built from; by default the
        one shipped for the scene.
    forward_options : the map's options by name, e.g. ``{"fem_runs": 60}``.
    error_runs : FEM runs from which the forward map's own error is learned, so that the likelihood
        allows for it (``statistical_model/approximation_error``); 0 takes the map as exact.
    mesh_error_runs : the same on the next finer mesh, so that the mesh's error is allowed for, too.
    load_steps : in which every FEM solve follows the loading path from rest; 1 looks for its end.
    sampler : a name of :data:`calibrate.samplers.SAMPLERS`.
    sampler_options : its options by name, e.g. ``{"target_accept": 0.95}``.
    warmup : adapting iterations, not kept.
    draws : kept iterations of a round, in each chain.
    chains : independent chains.
    seed : of synthetic data, of the design of FEM runs and of the sampler.
    """

    scene: str
    root: str | None = None
    data: str | dict[str, str] = "synthetic"
    truth: dict[str, float] = field(default_factory=dict)
    known: dict[str, float] = field(default_factory=dict)
    observe: str = "nodes:20"
    prior: dict[str, Any] | str = "box"
    noise: Mapping[str, float | dict[str, Any]] | float = field(default_factory=dict)
    noise_scale: Mapping[str, float] | float = field(default_factory=dict)
    discrepancy: Mapping[str, dict[str, Any]] = field(default_factory=dict)
    systematic: Mapping[str, dict[str, Any]] = field(default_factory=dict)
    check_scale: bool = True
    forward: str = "emulator"
    emulator: str | None = None
    forward_options: dict[str, Any] = field(default_factory=dict)
    error_runs: int = 0
    mesh_error_runs: int = 0
    load_steps: int = 1
    sampler: str = "nuts"
    sampler_options: dict[str, Any] = field(default_factory=dict)
    warmup: int = 500
    draws: int = 1000
    chains: int = 4
    seed: int = 0

    def __post_init__(self) -> None:
        registry.full_options(self.forward, self.forward_options)
        registry.check_emulator(self.forward, self.emulator)
        for name in ("warmup", "draws", "chains", "load_steps"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}; it must be 1 or more")
        if self.truth and self.data != "synthetic":
            raise InputError(f"truth has no effect beside data file {self.data}; leave one out")
        for name in ("error_runs", "mesh_error_runs"):
            if getattr(self, name) < 0:
                raise InputError(f"{name} is {getattr(self, name)}; it must be 0 or more")
        if self.error_runs and self.mesh_error_runs:
            raise InputError(
                "error_runs and mesh_error_runs are both given; the latter see the map's error, too"
            )
        for name, description in self.systematic.items():
            shared_error(name, description)
        if self.systematic and (self.error_runs or self.mesh_error_runs):
            raise InputError(
                "systematic and error_runs are both given; a likelihood allows for one of them"
            )
        if self.seed < 0:
            raise InputError(f"seed is {self.seed}; it must be 0 or more")

    def named(self, observe: Observations) -> Run:
        """The run with every noise by name, the defaults filled in."""
        scales = _by_name(self.noise_scale, observe, "noise-scale")
        given = _by_name(self.noise, observe, "noise")
        full = observe.expand(given, "noise")
        defaults = {
            split(name)[0]: part.default_noise.upper_sd
            for name, part in observe.parts.items()
            if name not in full
        }
        return replace(self, noise={**defaults, **given}, noise_scale=scales)

    def noises(self, observe: Observations) -> dict[str, Noise]:
        """Noise of each observation in the likelihood."""
        run = self.named(observe)
        assert isinstance(run.noise, Mapping)
        assert isinstance(run.noise_scale, Mapping)
        inferred = observe.expand(run.noise_scale, "noise-scale")
        wrong = observe.expand(run.discrepancy, "discrepancy")
        found: dict[str, Noise] = {}
        for name, (source, given) in observe.expand(run.noise, "noise").items():
            scale_source, scale = inferred.get(name, (source, None))
            wrong_source, discrepancy = wrong.get(name, (source, None))
            # What is said about one load state only makes its noise one of its own.
            own = name in (source, scale_source, wrong_source)
            found[name if own else source] = _noise(name, observe, given, scale, discrepancy)
        return found

    def synthetic_noise(self, observe: Observations) -> dict[str, Noise]:
        """Noise of each observation of synthetic data."""
        named = replace(self, noise_scale={}, discrepancy={}).noises(observe)
        each = {name: noise for name, (_, noise) in observe.expand(named, "noise").items()}
        return at_sites(each, observe)


def _by_name[T](
    given: Mapping[str, T] | float, observe: Observations, what: str
) -> dict[str, T | float]:
    """Values by the observation's name; a bare one is a single observation's or displacements'.

    A name without its load state stands for every state.
    """
    if not isinstance(given, Mapping):
        bases = observe.bases
        if len(bases) > 1 and DISPLACEMENT not in bases:
            raise InputError(f"{what}: give one for each of {', '.join(bases)}, by name")
        return {DISPLACEMENT if len(bases) > 1 else bases[0]: given}
    observe.expand(given, what)
    return dict(given)


def _noise(
    name: str,
    observe: Observations,
    given: float | Mapping[str, Any],
    scale: float | None,
    discrepancy: Mapping[str, Any] | None,
) -> Noise:
    try:
        noise = noise_of(given)
        noise = noise if scale is None else noise.inferred(scale)
        return noise if discrepancy is None else with_discrepancy(noise, discrepancy)
    except InputError as error:
        raise InputError(f"{name} ({observe.parts[name].unit}): {error}") from error
