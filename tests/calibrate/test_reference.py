from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from calibrate import reference
from calibrate.reference import outside_reference, published_reference, sample_outside
from emulator.errors import InputError
from emulator.fem.assembly import relative_residual
from emulator.fem.solution import Status
from emulator.geometry.bodies.box import box
from emulator.mechanics.laws import find_law
from emulator.released.scenes import published_scene
from emulator.scenes import Parameter, Scene, Support
from emulator.scenes.loads.dead import Gravity

MU, LAM = Parameter("mu", "kPa", 3.5, 10.0, "log"), Parameter("lam", "kPa", 3.5, 10.0, "log")


@pytest.fixture(scope="module")
def hanging() -> Scene:
    """A block in mm and kPa, its parameters not in the release's order."""
    return Scene(
        name="hanging",
        mesh=box((20.0, 10.0, 10.0), (2, 1, 1)),
        law=find_law("neo_hookean"),
        parameters=(MU, LAM),
        loads=(Gravity(density=1.0, direction=(0.0, 0.0, -1.0), acceleration=9.80),),
        supports=(Support("left"),),
    )


@pytest.fixture(scope="module")
def simulator(hanging):
    return em.Simulator(hanging)


@pytest.fixture(scope="module")
def simulators():
    return {}


@pytest.fixture(autouse=True)
def compiled_once(simulators, monkeypatch):
    """One simulator a scene, whichever test asks for it."""
    once = lambda scene: simulators.setdefault(scene.fingerprint, em.Simulator(scene))
    monkeypatch.setattr(reference, "Simulator", once)


@pytest.fixture(scope="module")
def released(hanging, simulator, tmp_path_factory):
    """The same as the release would have it: cm, barye and erg, theta = (lam, mu), no fields."""
    root = tmp_path_factory.mktemp("released")
    geometry, test = root / "Liver/geometryData", root / "Liver/simulationData/test"
    geometry.mkdir(parents=True)
    test.mkdir(parents=True)
    np.save(geometry / "reference-coords.npy", hanging.mesh.nodes / 10.0)
    np.save(geometry / "elements.npy", hanging.mesh.elements)
    np.save(geometry / "interior-points.npy", ~hanging.held.any(axis=1))
    lam_mu = np.array([[4.0, 9.0], [8.0, 5.0]])
    np.save(test / "theta.npy", lam_mu * 1e4)
    Pi = jax.jit(em.potential_energy(hanging))
    energy = [float(Pi(simulator(t), t)) for t in jnp.asarray(lam_mu[:, ::-1])]
    np.save(test / "pe-values.npy", np.array(energy) * 10.0)  # 1 mN mm = 10 erg
    return root / "Liver"


@pytest.fixture(scope="module")
def out_of_balance(simulator):
    return jax.jit(lambda u, theta: relative_residual(simulator.system, u, theta))


def test_released_energies_without_fields(hanging, released, out_of_balance):
    found = published_reference(hanging, released)
    assert found.source == "our FEM at the released theta"
    np.testing.assert_allclose(found.thetas, [[9.0, 4.0], [5.0, 8.0]])
    for theta, u in zip(found.thetas, found.displacement, strict=True):
        assert out_of_balance(u, theta) < 1e-8


def test_energies_that_are_not_ours_are_named(hanging, released):
    path = released / "simulationData/test/pe-values.npy"
    kept = np.load(path)
    try:
        np.save(path, kept * [1.0, 1.0 + 3e-6])
        with pytest.raises(
            InputError, match=r"'Liver': our FEM's energy in case 1 .* difference 3e"
        ):
            published_reference(hanging, released)
    finally:
        np.save(path, kept)


def test_another_scene_is_refused(hanging, released):
    stiff = replace(hanging, parameters=(MU,), constants={"lam": 5.0})
    with pytest.raises(InputError, match="'Liver' is not the scene 'hanging'"):
        published_reference(stiff, released)


def test_what_makes_two_scenes_the_same(published):
    ours = published_scene("LeftVentricle", published)
    turned = np.random.default_rng(0).permutation(len(ours.fibres))
    elements, fibres = ours.mesh.elements[turned], ours.fibres[turned]
    listed = replace(ours, mesh=replace(ours.mesh, elements=elements), fibres=fibres)
    assert reference._same(ours, listed)
    assert not reference._same(ours, replace(listed, fibres=ours.fibres))
    assert not reference._same(ours, replace(ours, constants={"kappa": 30.0}))


@pytest.mark.slow
def test_released_models_without_fields(published):
    for model, cases in (("Liver", 241), ("LeftVentricle", 75)):
        found = published_reference(published_scene(model, published), published / model)
        assert len(found.displacement) == cases


def test_outside_the_box(hanging):
    thetas = np.asarray(sample_outside(hanging, 40, 0.25))
    position = np.asarray(hanging.to_unit(jnp.asarray(thetas)))
    assert thetas.shape == (40, 2)
    assert ((position < 0.0) | (position > 1.0)).any(axis=1).all()
    assert position.min() >= -0.25
    assert position.max() <= 1.25
    assert (position.min() < -0.15) & (position.max() > 1.15)
    # A uniform range widened past zero, and a Poisson ratio past a half, hold values to leave out.
    near = replace(hanging, parameters=(Parameter("mu", "kPa", 1.0, 3.0), LAM))
    assert np.asarray(sample_outside(near, 40, 1.0))[:, 0].min() > 0.0
    nu = np.asarray(sample_outside(em.scenes.twisting_cube(cells=1), 40, 0.5))[:, 1]
    assert 0.45 < nu.max() < 0.5
    with pytest.raises(InputError, match="outside is -1"):
        sample_outside(hanging, 4, -1.0)


def test_solves_that_fail_outside_are_counted(hanging, simulator, out_of_balance):
    class Brittle(em.Simulator):
        def solve(self, theta, start=None):
            solution = super().solve(theta, start)
            soft = jnp.where(theta[0] < MU.low, Status.LOAD_LIMIT, solution.status)
            return solution._replace(status=soft)

    brittle = Brittle(hanging)
    vars(brittle).update(_driver=simulator._driver)  # compiled already
    found = outside_reference(brittle, 8, 0.25, reference.fem_reference(brittle, 2))
    soft = int((np.asarray(sample_outside(hanging, 8, 0.25))[:, 0] < MU.low).sum())
    assert 0 < soft < 8
    assert found.failed == soft
    assert len(found.thetas) == len(found.displacement) == 8 - soft
    assert found.thetas[:, 0].min() >= MU.low
    assert out_of_balance(found.displacement[0], found.thetas[0]) < 1e-8
