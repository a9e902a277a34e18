from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.fem import Status
from emulator.geometry.generators.ellipsoid import human_ventricle
from emulator.mechanics.laws import find_law
from emulator.scenes import Parameter, Scene, Support
from emulator.scenes.fibre_rules import Helix
from emulator.scenes.loads import CavityPressure

# Shear of pig myocardium, Holzapfel & Ogden (2009), Table 1.
PIG = {
    "a": 0.059,
    "b": 8.023,
    "a_f": 18.472,
    "b_f": 16.026,
    "a_s": 2.481,
    "b_s": 11.12,
    "a_fs": 0.216,
    "b_fs": 11.436,
}


@pytest.fixture(scope="module")
def ventricle():
    mesh = human_ventricle(5, 12, 1)
    fibres, sheets = Helix((60.0, -60.0)).directions(mesh)
    return Scene(
        name="orthotropic ventricle",
        mesh=mesh,
        law=find_law("holzapfel_ogden_orthotropic"),
        parameters=(Parameter("pressure", "kPa", 0.5, 1.5),),
        loads=(CavityPressure("endocardium"),),
        supports=(Support("base"),),
        constants={**PIG, "kappa": 25.0},
        fibres=fibres,
        sheets=sheets,
    )


@pytest.mark.slow
def test_an_orthotropic_ventricle_fills(ventricle):
    assert ventricle.tissue_at(ventricle.centre).directions.shape == (
        len(ventricle.mesh.elements),
        1,
        2,
        3,
    )
    solution = em.Simulator(ventricle).solve(ventricle.centre)
    assert Status(int(solution.status)) is Status.CONVERGED


def test_the_law_without_sheets_is_a_limit_of_it(ventricle):
    weak = {**ventricle.constants, "a_s": 1e-12, "a_fs": 1e-12}
    plain = {name: PIG[name] for name in ("a", "b", "a_f", "b_f")}
    without = replace(
        ventricle,
        law=find_law("holzapfel_ogden"),
        constants={**plain, "kappa": 25.0},
        sheets=None,
    )
    u = 0.3 * jnp.asarray(np.random.default_rng(0).normal(size=ventricle.held.shape))
    expected = em.fem.potential_energy(without)(u, without.centre)
    with_weak = em.fem.potential_energy(replace(ventricle, constants=weak))
    assert with_weak(u, ventricle.centre) == pytest.approx(float(expected), rel=1e-9)


def test_a_scene_without_sheets_does_not_pay_for_them(ventricle):
    def operations(scene):
        energy = em.fem.potential_energy(scene)
        return len(jax.make_jaxpr(energy)(jnp.zeros(scene.held.shape), scene.centre).jaxpr.eqns)

    plain = {name: PIG[name] for name in ("a", "b", "a_f", "b_f")}
    constants = {**plain, "kappa": 25.0}
    law = find_law("holzapfel_ogden")
    without = replace(ventricle, law=law, constants=constants, sheets=None)
    np.testing.assert_array_equal(
        without.tissue_at(without.centre).directions, without.fibres[:, None]
    )
    assert operations(without) < operations(ventricle)


def test_sheets_that_do_not_fit(ventricle):
    with pytest.raises(InputError, match="law 'holzapfel_ogden_orthotropic' needs sheets"):
        replace(ventricle, sheets=None)
    with pytest.raises(InputError, match=r"sheets have shape \(1, 3\)"):
        replace(ventricle, sheets=ventricle.sheets[:1])
    with pytest.raises(InputError, match=r"sheets are not across the fibres \(cosine 1\)"):
        replace(ventricle, sheets=ventricle.fibres)
    with pytest.raises(InputError, match="sheets are not unit vectors"):
        replace(ventricle, sheets=2.0 * ventricle.sheets)
    assert replace(ventricle, sheets=-ventricle.sheets).fingerprint != ventricle.fingerprint
