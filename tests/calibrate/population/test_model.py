"""Which unknowns are shared: the material, not the loads of a member or of its load states."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest

import calibrate as cal
import emulator as em
from calibrate.population import population_model
from calibrate.population.model import _common_parameter
from emulator.core.errors import InputError
from emulator.scenes.parameter_space import LogNormal
from linear_support import linear_forward


def model_of(scene, *states, **more):
    part = cal.nodal_displacements(scene, [3, 11])
    parts = {f"displacement@{state}": part for state in states} if states else part
    noise = cal.GaussianNoise(sd=0.1)
    return cal.model(linear_forward(scene), parts, noise, check_scale=False, **more)


def test_loads_and_noise_are_a_member_s_own(ventricle):
    one, two = model_of(ventricle), model_of(ventricle, "p4", "p8")
    found = population_model({"one": one, "two": two})
    material = [n for n in ventricle.parameter_names if n not in ventricle.load_parameters]
    assert ventricle.load_parameters == ("pressure",)
    assert list(found.shared) == material
    assert found.unshared == {"one": ("pressure",), "two": ("pressure@p4", "pressure@p8")}
    assert list(population_model({"one": one}, shared=("pressure",)).shared) == ["pressure"]


def test_nothing_in_common_is_refused(ventricle):
    model = model_of(ventricle)
    known = {n: 0.5 * (p.low + p.high) for n, p in zip(ventricle.parameter_names, ventricle.parameters, strict=True)}  # fmt: skip
    del known["pressure"]
    bare = cal.model(
        model.full, model.observe, cal.GaussianNoise(sd=0.1), known=known, check_scale=False
    )
    with pytest.raises(InputError, match="no unknown but those of loads is one of every member"):
        population_model({"one": model, "two": bare})


def test_the_population_s_priors_are_made_of_the_members(beam):
    """The median has theirs, the sd is rarely as large as theirs; on the parameter's scale."""
    box = population_model({"one": model_of(beam)})
    prior = cal.priors.Population({"mu": 70.0}, {"mu": 0.05}).prior(beam)
    stated = population_model({"one": model_of(beam, prior=prior)}, shared=("mu",))
    for found, sd in ((box, np.log(2.0) / np.sqrt(12.0)), (stated, 0.05)):
        spreads = np.asarray(found.spread["mu"].sample(jax.random.key(0), (20_000,)))
        assert np.sqrt(np.mean(spreads**2)) == pytest.approx(0.5 * sd, rel=0.05)
        medians = np.log(np.asarray(found.median["mu"].sample(jax.random.key(1), (5000,))))
        assert medians.mean() == pytest.approx(np.log(np.sqrt(5000.0)), abs=0.02)
        assert medians.std() == pytest.approx(sd, rel=0.05)


def test_members_share_ranges_but_not_what_their_scene_files_say_of_them():
    """Scene files that are drafted from each member's data state another prior each."""

    def member(median, low=0.1):
        prior = LogNormal(median, 1.0, "a guess")
        parameter = em.Parameter("mu", "kPa", low, 9.0, "log", prior)
        scene = SimpleNamespace(parameters=(parameter,), parameter_names=("mu",))
        return SimpleNamespace(forward=SimpleNamespace(scene=scene))

    assert _common_parameter({"a": member(1.0), "b": member(2.0)}, "mu").low == 0.1
    with pytest.raises(InputError, match="a population has one range and one scale"):
        _common_parameter({"a": member(1.0), "b": member(1.0, low=0.2)}, "mu")
