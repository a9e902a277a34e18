"""The networks released with the paper: the released code's predictions are the oracle."""

import pickle
import shutil

import jax
import numpy as np
import pytest
from flax.core import FrozenDict
from jax._src.array import _reconstruct_array

import emulator as em
from calibrate.cli import main
from emulator.core.errors import InputError
from emulator.fem.campaign import solve_together
from emulator.released.network import read_network
from emulator.released.scenes import published_tests, units
from emulator.surrogates.network.pignn import Processor
from emulator.surrogates.released_network import released_network

MODELS = ("TwistingBeam", "Liver", "LeftVentricle")
PICKLE = "emulationResults/trainedParameters/{}/trainedNetworkParams.pkl"


@pytest.fixture(scope="module")
def twisting(published):
    return released_network("TwistingBeam", published)


def tree_of(weights):
    """Nested dictionaries, as the release pickles them."""
    tree = {}
    for name, array in weights.items():
        *folders, last = ("params", *name.split("/"))
        inner = tree
        for folder in folders:
            inner = inner.setdefault(folder, {})
        inner[last] = array
    return tree


@pytest.fixture
def clone(published, tmp_path):
    """A clone of the release whose network of TwistingBeam is a pickle, and that network."""
    shutil.copytree(published / "TwistingBeam", tmp_path / "data" / "TwistingBeam")
    shutil.rmtree(tmp_path / "data" / "TwistingBeam" / "trained")
    path = tmp_path / PICKLE.format("TwistingBeam")
    path.parent.mkdir(parents=True)
    weights = read_network(published, "TwistingBeam").weights
    path.write_bytes(pickle.dumps(tree_of(weights)))
    return tmp_path, path, weights


@pytest.mark.slow
@pytest.mark.parametrize(
    "model", [m if m == "TwistingBeam" else pytest.param(m, marks=pytest.mark.slow) for m in MODELS]
)
def test_predictions_are_those_of_the_released_code(published, model):
    emulator = released_network(model, published)
    thetas, _ = published_tests(model, published)
    expected = np.load(published / model / "trained" / "displacement-predicted.npy")
    expected = expected * units(model).length
    cached = emulator.cache()
    found = np.asarray(jax.jit(jax.vmap(cached))(thetas[:25]))
    largest = np.abs(expected).max(axis=(1, 2), keepdims=True)
    assert np.max(np.abs(found - expected) / largest) < 1e-6
    np.testing.assert_allclose(emulator(thetas[7]), found[7], atol=1e-6 * largest[7].item())


def test_errors_are_those_that_the_paper_s_network_leaves(published, twisting):
    thetas, tests = published_tests("TwistingBeam", published)
    found = np.asarray(jax.jit(jax.vmap(twisting.cache()))(thetas))
    err_u = np.median(np.linalg.norm(found - tests.displacement, axis=-1))
    assert err_u == pytest.approx(9.4e-5, abs=0.05e-5)


@pytest.mark.slow
def test_errors_of_the_ventricle_against_our_fem(published):
    emulator = released_network("LeftVentricle", published)
    thetas, tests = published_tests("LeftVentricle", published)
    solved = solve_together(em.Simulator(emulator.scene), thetas)
    assert solved.converged.all()
    found = jax.jit(jax.vmap(emulator.cache()))(thetas)
    err_u = np.median(np.linalg.norm(found - solved.displacement, axis=-1))
    assert err_u == pytest.approx(3.0e-2, abs=0.05e-2)
    energy = jax.jit(jax.vmap(em.fem.potential_energy(emulator.scene)))(found, thetas)
    err_pi = 100.0 * np.median(np.abs((energy - tests.energy) / tests.energy))
    assert err_pi == pytest.approx(1.2e-2, abs=0.05e-2)


@pytest.mark.slow
def test_energies_of_the_liver(published):
    emulator = released_network("Liver", published)
    thetas, tests = published_tests("Liver", published)
    found = jax.jit(jax.vmap(emulator.cache()))(thetas)
    energy = jax.jit(jax.vmap(em.fem.potential_energy(emulator.scene)))(found, thetas)
    err_pi = 100.0 * np.median(np.abs((energy - tests.energy) / tests.energy))
    assert err_pi == pytest.approx(1.4e-2, abs=0.05e-2)


@pytest.mark.slow
def test_the_cached_map_never_runs_the_processor(twisting, monkeypatch):
    runs, call = [], Processor.__call__
    monkeypatch.setattr(Processor, "__call__", lambda *a: runs.append(1) or call(*a))
    cached = twisting.cache()
    assert len(runs) == 1
    theta = twisting.scene.centre
    for function in (cached, jax.jit(cached), jax.jacfwd(cached), cached.at(np.arange(5))):
        function(theta)
    jax.vmap(cached)(theta[None])
    assert len(runs) == 1
    twisting(theta)
    assert len(runs) == 2


def test_theta_enters_as_it_is_not_as_its_position(twisting):
    """Standardised by the release's mean and sd, which are not those of the box."""
    network, theta = twisting.network, twisting.scene.theta(E=7.455468, nu=0.21638316)
    np.testing.assert_allclose(network.normalise(twisting.scene.to_unit(theta)), 0.0, atol=1e-6)


def test_a_clone_with_a_pickle_gives_the_same_network(clone, twisting):
    folder, path, weights = clone
    for protocol in range(6):
        path.write_bytes(pickle.dumps(tree_of(weights), protocol=protocol))
        for root in (folder, folder / "data"):
            found = read_network(root, "TwistingBeam").weights
            assert found.keys() == weights.keys()
            assert all(np.array_equal(found[name], weights[name]) for name in weights)
    theta = twisting.scene.centre
    again = released_network("TwistingBeam", folder)
    np.testing.assert_array_equal(again(theta), twisting(theta))


def test_the_pickle_of_the_release_itself_is_read(published, tmp_path):
    """The ventricle's, byte for byte: Flax's frozen dictionaries of JAX arrays."""
    released = published / "LeftVentricle" / "trained" / "trainedNetworkParams.pkl"
    if not released.is_file():
        pytest.skip("no released pickle beside the published data")
    shutil.copytree(
        published / "LeftVentricle",
        tmp_path / "data" / "LeftVentricle",
        ignore=shutil.ignore_patterns("trained", "simulationData"),
    )
    path = tmp_path / PICKLE.format("LeftVentricle")
    path.parent.mkdir(parents=True)
    shutil.copyfile(released, path)
    found = read_network(tmp_path, "LeftVentricle").weights
    expected = read_network(published, "LeftVentricle").weights
    assert found.keys() == expected.keys()
    assert all(np.array_equal(found[name], expected[name]) for name in expected)
    # One name in it changed, of as many letters.
    path.write_bytes(path.read_bytes().replace(b"_reconstruct_array", b"_reconstrukt_array", 1))
    with pytest.raises(InputError, match="asks for jax._src.array._reconstrukt_array"):
        read_network(tmp_path, "LeftVentricle")


class Call:
    """What pickles to a call of ``function``."""

    def __init__(self, function, *arguments):
        self.function, self.arguments = function, arguments

    def __reduce__(self):
        return self.function, self.arguments


def within_itself():
    """A dictionary that holds itself."""
    around = {}
    around["x"] = around
    return around


def test_a_pickle_that_calls_anything_is_refused(clone, tmp_path):
    folder, path, weights = clone
    mark = tmp_path / "called"
    some = next(iter(weights.values()))
    for thing, message in (
        (Call(open, str(mark), "w"), "asks for (_io|io).open"),
        (Call(exec, f"open({str(mark)!r}, 'w')"), "asks for builtins.exec"),
        (Call(eval, "1"), "asks for builtins.eval"),
        (Call(getattr, "a", "b"), "asks for builtins.getattr"),
        (np.float64, "asks for numpy.float64"),
        (Call(_reconstruct_array, open, (str(mark), "w"), (), {}), "asks for (_io|io).open"),
        (Call(_reconstruct_array, FrozenDict, (), (), {}), "makes something else of an array"),
        (Call(FrozenDict, [some]), "makes something else of a dictionary"),
        (np.array([Call(open, str(mark), "w")], dtype=object), "asks for"),
        (np.array([None]), "holds a ndarray at 'params/x'"),
        ([some], "holds a list at 'params/x'"),
        (1.5, "holds a float at 'params/x'"),
        (within_itself(), "nests more than 8 dictionaries, at 'params/x/x/x"),
        (some.astype(np.int64), "holds a ndarray"),
        (some.astype(float), "is not of finite float32"),
        (np.full(3, np.nan, np.float32), "is not of finite float32"),
    ):
        path.write_bytes(pickle.dumps({"params": {"x": thing}}))
        with pytest.raises(InputError, match=message) as refused:
            read_network(folder, "TwistingBeam")
        assert "\n" not in str(refused.value)
        assert str(path) in str(refused.value)
    assert not mark.exists()


def test_what_does_not_fit_is_said(clone, published):
    folder, path, weights = clone
    model = folder / "data" / "TwistingBeam"

    def refused(match):
        with pytest.raises(InputError, match=match):
            released_network("TwistingBeam", folder)

    path.write_bytes(b"\x80\x04nonsense")
    refused("is not a readable pickle")
    path.write_bytes(b"")
    refused("is not a readable pickle")
    liver = read_network(published, "Liver").weights
    path.write_bytes(pickle.dumps(tree_of(liver)))
    refused("these weights are not of TwistingBeam: .* has an energy of")
    ventricle = read_network(published, "LeftVentricle").weights
    path.write_bytes(pickle.dumps(tree_of(ventricle)))
    refused(r"array '.*' has shape \(4, 128\); expected \(2, 128\)")
    path.write_bytes(
        pickle.dumps(tree_of({**weights, "FlaxMLP_99/x": weights["LayerNorm_0/bias"]}))
    )
    refused("array 'FlaxMLP_99/x' is unknown")
    fewer = {name: array for name, array in weights.items() if name != "LayerNorm_0/bias"}
    path.write_bytes(pickle.dumps(tree_of(fewer)))
    refused("array 'processor/norm/bias' is missing")
    path.write_bytes(pickle.dumps(tree_of(weights)))
    labels = np.load(model / "geometryData" / "node-layer-labels.npy")
    np.save(model / "geometryData" / "node-layer-labels.npy", labels[::-1])
    refused("does not begin with the 343 nodes of its mesh")
    np.save(model / "geometryData" / "node-layer-labels.npy", labels)
    pairs = np.load(model / "geometryData" / "sparse-topology.npy")
    np.save(model / "geometryData" / "sparse-topology.npy", pairs + 9999)
    refused("joins nodes there are none of")
    path.unlink()
    refused("no trained network of TwistingBeam: neither .* nor .* exists")
    with pytest.raises(InputError, match="published model 'Kidney' is unknown"):
        released_network("Kidney", folder)


def test_the_command_line_makes_an_emulator_of_it(published, twisting, tmp_path, capsys):
    folder = str(tmp_path / "net")
    assert main(["released", "TwistingBeam", "--root", str(published), "--out", folder]) == 0
    assert "theta is E, nu" in capsys.readouterr().out
    again = em.load(folder)
    assert again.fingerprint == twisting.fingerprint
    theta = again.scene.centre
    np.testing.assert_array_equal(again(theta), twisting(theta))
    assert main(["predict", folder]) == 0
    assert main(["released", "Kidney", "--root", str(published), "--out", folder]) == 2
    assert "published model 'Kidney' is unknown" in capsys.readouterr().err
