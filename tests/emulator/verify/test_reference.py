from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.released.scenes import published_scene
from emulator.scenes import Scene
from emulator.verify import released as module
from emulator.verify.released import published_reference
from scene_support import MU, hanging_block


@pytest.fixture(scope="module")
def hanging() -> Scene:
    return hanging_block()


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
    monkeypatch.setattr(module, "Simulator", once)


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
    Pi = jax.jit(em.fem.potential_energy(hanging))
    energy = [float(Pi(simulator(t), t)) for t in jnp.asarray(lam_mu[:, ::-1])]
    np.save(test / "pe-values.npy", np.array(energy) * 10.0)  # 1 mN mm = 10 erg
    return root / "Liver"


@pytest.fixture(scope="module")
def out_of_balance(simulator):
    return jax.jit(simulator.system.relative_residual)


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


@pytest.mark.slow
def test_released_models_without_fields(published):
    for model, cases in (("Liver", 241), ("LeftVentricle", 75)):
        found = published_reference(published_scene(model, published), published / model)
        assert len(found.displacement) == cases
