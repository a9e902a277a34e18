"""Draws of a posterior on another scene: against FEM at the draws, and what is refused."""

import json
from dataclasses import replace

import jax
import meshio
import numpy as np
import pytest

import calibrate as cal
import emulator as em
from calibrate.cli import main
from calibrate.prediction import Learned, predict_on
from calibrate.prediction.beyond import Beyond, _measures, how_far_beyond, widened
from calibrate.prediction.output import write_fields
from calibrate.samplers.laplace import LaplaceOptions
from emulator.core.errors import InputError, SolverError
from emulator.fem.campaign import workers
from emulator.fem.solution import Status
from emulator.scenes.parameter_space import LogNormal, Parameter
from emulator.scenes.tissue_priors import scatter_of
from emulator.specimens.homogeneous import homogeneous
from emulator.specimens.states import states
from emulator.surrogates.taylor import expand

DRAWS = LaplaceOptions(draws=200, chains=2, starts=2)


@pytest.fixture(scope="module")
def posterior(beam, simulator):
    """Of both moduli of the beam, from its tip."""
    forward = em.Emulator(beam, taylor=expand(simulator, order=3)).cache()
    observe = cal.nodal_displacements(beam, "right")
    theta = beam.theta(mu=75.0, lam=70.0)
    u = np.asarray(simulator(theta))[observe.nodes]
    y = u + 0.3 * np.random.default_rng(0).normal(size=u.shape)
    model = cal.model(forward, observe, cal.GaussianNoise(sd=0.3))
    return cal.sample(model, y, sampler="laplace", options=DRAWS, seed=1)


@pytest.fixture(scope="module")
def shorter(beam):
    """Another body of the same tissue, pulled by a larger gravity in a direction of its own."""
    del beam
    scene = em.scenes.once_clamped_beam(cells=(3, 1, 1), order=1)
    return replace(scene, loads=(em.loads.Gravity(), em.loads.Traction("right", (0.0, 0.1, 0.0))))


@pytest.fixture(scope="module")
def predicted(posterior, shorter):
    return predict_on(posterior, shorter, cal.nodal_displacements(shorter, "right"), draws=200)


def test_what_is_predicted_is_fem_at_the_draws(predicted):
    values, simulator = predicted.values["displacement"], em.Simulator(predicted.scene)
    assert predicted.missed <= 0.05
    assert 18 <= predicted.runs < 60
    assert predicted.warnings == []
    assert set(predicted.sources.values()) == {"the posterior"}
    nodes, sd = predicted.observe.nodes, values.std(axis=0).max()
    for k in range(0, 200, 23):
        exact = np.asarray(simulator(predicted.thetas[k, 0]))[nodes]
        np.testing.assert_allclose(values[k], exact, atol=0.15 * sd)
        whole = np.asarray(predicted.forward(predicted.thetas[k, 0]))
        np.testing.assert_allclose(whole[nodes], exact, atol=0.15 * sd)


def test_fields_of_a_body_are_those_of_fem_over_the_draws(predicted, tmp_path):
    """Its stress and strain too, of which mean and quantiles go into a file."""
    content = meshio.read(tmp_path / write_fields(predicted, 0, tmp_path))
    scene, thetas = predicted.scene, predicted.thetas[:100, 0]
    simulator = em.Simulator(scene)
    rows = [em.fem.element_fields(scene, simulator(theta), theta) for theta in thetas[::9]]
    for name in ("cauchy_stress", "green_lagrange"):
        low, high = (content.cell_data[f"{name}_{end}"][0] for end in ("low", "high"))
        values = np.stack([row[name].reshape(len(low), 9) for row in rows])
        size, mean = np.abs(values).max(), content.cell_data[name][0]
        np.testing.assert_allclose(mean, values.mean(axis=0), atol=0.05 * size)
        assert 0.8 < np.mean((values >= low - 1e-6 * size) & (values <= high + 1e-6 * size)) < 1.0
    u = np.asarray(jax.lax.map(predicted.forward, thetas))
    np.testing.assert_allclose(content.point_data["displacement"], u.mean(axis=0), atol=1e-12)
    np.testing.assert_allclose(content.point_data["displacement_sd"], u.std(axis=0), atol=1e-12)


def test_a_summary_is_of_the_values(predicted):
    row, values = predicted.summary()["displacement"], predicted.values["displacement"]
    np.testing.assert_allclose(row["mean"], values.mean(axis=0))
    assert (row["low"] <= row["median"]).all()
    assert (row["median"] <= row["high"]).all()
    inside = (values >= row["low"]) & (values <= row["high"])
    assert inside.mean() == pytest.approx(0.9, abs=0.02)


def test_a_support_that_moves_past_the_elements_beside_it_is_predicted(posterior, beam):
    """As far as a body at rest would have inverted elements; and a number that is always zero."""
    moved = em.Support("right", (-1.0, 0.0, 0.0), amount="pressed")
    scene = replace(
        beam,
        mesh=em.generators.box((20.0, 10.0, 10.0), (10, 1, 1)),
        supports=(em.Support("left"), moved),
        loads=(),
        parameters=(*beam.parameters, Parameter("pressed", "", 0.1, 9.0)),
        origin={},
    )
    force = {
        "reaction": cal.Reaction(scene, "right", "x"),
        "held": cal.nodal_displacements(scene, "left"),
    }
    predicted = predict_on(posterior, scene, force, known={"pressed": 4.0}, draws=60)
    simulator = em.Simulator(predicted.scene)
    for k in (3, 40):
        theta = predicted.thetas[k, 0]
        exact = float(simulator.reaction("right", simulator(theta), theta)[0]) / 1000.0
        assert predicted.values["reaction"][k] == pytest.approx(exact, rel=2e-3)
    assert predicted.missed <= 0.05
    assert predicted.runs < 40
    assert not predicted.values["held"].any()


def test_what_the_posterior_lacks_has_its_own_prior(posterior, shorter):
    """A pressure that is given, and one that is drawn; each is named."""
    observe = cal.nodal_displacements(shorter, "right")
    loaded = replace(
        shorter,
        parameters=(*shorter.parameters, Parameter("pull", "kPa", 0.05, 0.2)),
        loads=(em.loads.Gravity(), em.loads.DeadPressure("right", parameter="pull")),
    )
    given = predict_on(posterior, loaded, observe, known={"pull": 0.1}, draws=60)
    assert given.sources["pull"] == "given"
    assert set(np.asarray(given.thetas)[:, 0, 2]) == {0.1}
    ranged = predict_on(posterior, loaded, observe, draws=60)
    assert ranged.sources["pull"] == "its range in the scene, 0.05 to 0.2"
    assert 0.05 < ranged.draws["pull"].min() < ranged.draws["pull"].max() < 0.2
    prior = LogNormal(0.1, 0.3, "a guess")
    stated = replace(loaded.parameters[2], prior=prior)
    drawn = predict_on(
        posterior, replace(loaded, parameters=(*loaded.parameters[:2], stated)), observe, draws=60
    )
    assert "median 0.1, log sd 0.3" in drawn.sources["pull"]
    assert np.log(drawn.draws["pull"]).std() == pytest.approx(0.3, rel=0.3)


def test_bad_uses_are_refused_in_a_line(posterior, shorter):
    observe = cal.nodal_displacements(shorter, "right")
    other_law = replace(shorter, law=em.find_law("small_strain"))
    held = replace(shorter, parameters=shorter.parameters[:1], constants={"lam": 70.0})
    cases = (
        (other_law, {}, "give a scene of the same law"),
        (held, {}, "holds lam at 70, and the posterior infers it"),
        (shorter, {"known": {"mu": 60.0}}, "mu is known as 60, and the posterior infers it"),
        (shorter, {"known": {"pressure": 1.0}}, "has no parameter 'pressure'"),
        (shorter, {"draws": 5}, "5 draws; give 20 or more"),
    )
    for scene, options, words in cases:
        with pytest.raises(InputError, match=words) as caught:
            posterior.predict_on(scene, observe, **options)
        assert "\n" not in str(caught.value)


def test_fem_that_fails_is_named(posterior, shorter, monkeypatch):
    solve = workers.Solver.__call__

    def failing(solver, task):
        row = solve(solver, task)
        lost = row.solution._replace(status=np.asarray(int(Status.ITERATION_LIMIT)))
        return row._replace(solution=lost)

    monkeypatch.setattr(workers.Solver, "__call__", failing)
    with pytest.raises(SolverError, match="FEM fails at 12 of 12 draws"):
        predict_on(posterior, shorter, cal.nodal_displacements(shorter, "right"), draws=60)


def test_a_larger_load_reaches_beyond_the_data(posterior, beam):
    """The body of the data itself does not; one that is pulled further does."""
    learned = Learned.of(posterior)
    own = how_far_beyond(learned, beam, posterior.model.full, ("",), posterior.thetas()[:, None])
    assert {one.measure for one in own.reaches} == {"I1"}
    assert all(one.share == 0.0 for one in own.reaches)
    assert own.distances[""] < 0.01
    pulled = replace(beam, loads=(em.loads.Traction("right", (0.0, 0.0, -4.0)),))
    forward = em.Simulator(pulled)
    beyond = how_far_beyond(learned, pulled, forward, ("p1",), posterior.thetas()[:4, None])
    (far,) = beyond.reaches
    assert far.share > 0.2
    assert far.reached[1] > far.learned[1]
    assert "% of the body lies beyond" in str(far)
    assert far.learned[0] <= 3.0
    assert 0.1 < beyond.distances["p1"] < 2.0
    assert str(beyond).startswith(f"beyond the data by {beyond.distances['p1']:.2g} in p1 (log")


def test_distance_is_of_strain_over_the_datas_and_widens_what_differs_from_rest(predicted):
    """A piece pulled to 1.2 that goes on to 1.5, whose I1 - 3 is known by hand."""
    columns = {"stretch_x": np.array([1.0, 1.2])}
    law, parameter = em.find_law("neo_hookean_split"), em.Parameter("mu", "kPa", 1.0, 9.0)
    seen, further = (
        em.specimen(
            columns | {"stretch_x": x}, law=law, parameters=(parameter,), constants={"kappa": 1e4}
        )
        for x in (np.array([1.0, 1.2]), np.array([1.1, 1.5]))
    )
    forward = em.homogeneous(seen, incompressible=True)
    learned = Learned(seen, {"mu": np.ones(4)}, {}, [(forward, seen.centre[None])])
    thetas = further.centre[None, None]
    beyond = how_far_beyond(
        learned, further, em.homogeneous(further, incompressible=True), ("",), thetas
    )
    strain = [x**2 + 2.0 / x - 3.0 for x in (1.2, 1.5)]
    far = 0.5 * np.log(strain[1] / strain[0])
    np.testing.assert_allclose(beyond.distances[""], [0.0, far], rtol=1e-5)
    assert str(Beyond([], {"": np.zeros(2)})) == ""
    outer = widened(predicted, Beyond([], {"": np.array(0.3)}))
    for before, after in zip(predicted.values.values(), outer.values.values(), strict=True):
        factor = after / np.where(before == 0.0, 1.0, before)
        logs = np.log(factor[np.abs(before) > 1e-9].reshape(len(before), -1))
        np.testing.assert_allclose(logs, logs[:, :1] * np.ones(logs.shape[1]), atol=1e-9)
        assert logs[:, 0].std() == pytest.approx(0.3, rel=0.15)
    same = widened(predicted, Beyond([], {"": np.array(0.0)}))
    np.testing.assert_allclose(same.values["displacement"], predicted.values["displacement"])
    volume = cal.CavityVolume(em.scenes.left_ventricle(3, 6, 1))
    nothing = float(volume(np.zeros((len(volume.nodes), 3)), np.zeros(5)))
    filled = replace(
        predicted, observe=cal.measurements.observations(volume),
        values={"volume": np.full(200, nothing + 10.0)}, thetas=np.zeros((200, 1, 5)),
    )  # fmt: skip
    wide = widened(filled, Beyond([], {"": np.array(0.3)})).values["volume"] - nothing
    assert np.log(wide / 10.0).std() == pytest.approx(0.3, rel=0.15)


def test_measures_of_a_pulled_block_are_those_of_its_gradient():
    """A body and a specimen, by F = diag(1.3, 0.9, 0.8) and fibres at 30 degrees to x."""
    stretch, angle = np.array([1.3, 0.9, 0.8]), np.pi / 6.0
    fibre = np.array([np.cos(angle), np.sin(angle), 0.0])
    exact = {"I1": (stretch**2).sum(), "I4f": ((stretch * fibre) ** 2).sum()}
    law = em.find_law("holzapfel_ogden")
    constants = dict(zip(law.parameters, (1.0, 2.0, 3.0, 4.0, 25.0), strict=True))
    parameter = Parameter(law.parameters[0], "kPa", 0.5, 2.0)
    del constants[parameter.name]
    mesh = em.generators.box((2.0, 1.0, 1.0), (2, 1, 1))
    body = em.Scene(
        name="block", mesh=mesh, law=law, parameters=(parameter,), loads=(),
        supports=(em.Support("left"),), constants=constants,
        fibres=np.tile(fibre, (len(mesh.elements), 1)),
    )  # fmt: skip
    u = mesh.nodes * (stretch - 1.0)
    for name, (values, weights) in _measures(lambda _: u, body, body.centre).items():
        np.testing.assert_allclose(values, exact[name], rtol=1e-12)
        assert weights.sum() == pytest.approx(2.0)
    columns = {
        f"stretch_{axis}": np.array([value]) for axis, value in zip("xyz", stretch, strict=True)
    }
    piece = em.specimens.Specimen(
        name="piece", states=states(columns), law=law, parameters=(parameter,),
        constants=constants, fibres=fibre,
    )  # fmt: skip
    told = _measures(homogeneous(piece), piece, piece.centre)
    assert {name: float(values[0]) for name, (values, _) in told.items()} == pytest.approx(exact)


def test_fibres_decide_where_they_are_strained_more():
    """Pulled along the fibres to 1.1, then to 1.3: by hand, as both keep their volume."""
    law, parameter = em.find_law("holzapfel_ogden"), Parameter("a", "kPa", 0.5, 2.0)
    constants = {"b": 2.0, "a_f": 3.0, "b_f": 2.0, "kappa": 1e4}
    seen, further = (
        em.specimen(
            {"stretch_x": np.array([x])}, law=law, parameters=(parameter,),
            constants=constants, fibres=[1.0, 0.0, 0.0],
        )
        for x in (1.1, 1.3)
    )  # fmt: skip
    one, other = (em.homogeneous(piece, incompressible=True) for piece in (seen, further))
    learned = Learned(seen, {"a": np.ones(4)}, {}, [(one, seen.centre[None])])
    beyond = how_far_beyond(learned, further, other, ("",), further.centre[None, None])
    by_fibres = np.log((1.3**2 - 1.0) / (1.1**2 - 1.0))
    by_all = 0.5 * np.log((1.3**2 + 2.0 / 1.3 - 3.0) / (1.1**2 + 2.0 / 1.1 - 3.0))
    assert by_fibres > by_all
    np.testing.assert_allclose(beyond.distances[""], by_fibres, rtol=1e-5)
    assert [reach.measure for reach in beyond.reaches] == ["I1", "I4f"]


def test_distance_of_a_body_is_a_mean_by_what_is_strained():
    """A block that was stretched by 1.1, whose halves are stretched by 1.2 and 1.5."""
    mesh = em.generators.box((2.0, 1.0, 1.0), (2, 1, 1))
    block = em.Scene(
        name="block", mesh=mesh, law=em.find_law("neo_hookean_split"),
        parameters=(Parameter("mu", "kPa", 1.0, 9.0),), constants={"kappa": 10.0}, loads=(),
        supports=(em.Support("left"),),
    )  # fmt: skip
    x, along = mesh.nodes[:, 0], np.array([1.0, 0.0, 0.0])
    known, halves = 0.1 * x, np.where(x < 1.0, 0.2 * x, 0.2 + 0.5 * (x - 1.0))
    seen = lambda _: known[:, None] * along
    seen.scene = block
    learned = Learned(block, {"mu": np.ones(4)}, {}, [(seen, block.centre[None])])
    beyond = how_far_beyond(
        learned, block, lambda _: halves[:, None] * along, ("p",), block.centre[None, None]
    )
    strained = np.array([1.2, 1.5]) ** 2 - 1.0  # I1 - 3, of halves of one volume
    far = 0.5 * np.log(strained / (1.1**2 - 1.0))
    assert float(beyond.distances["p"]) == pytest.approx((far * strained).sum() / strained.sum())


TABLE = "stretch_x,stress_x [kPa]\n" + "".join(
    f"{x},{30.0 * (x - x**-2):.4f}\n" for x in (1.0, 1.05, 1.1, 1.15, 1.2)
)
PIECE = """
law = "neo_hookean"
specimen = "t.csv"
grips = "none"
parameters = {mu = {unit = "kPa", median = 20, log_sd = 0.7}}
constants = {lam = 1e5}
"""
BODY = """
mesh = "own.vtu"
law = "neo_hookean"
loads = [{kind = "gravity"}]
supports = [{node_set = "left"}]
parameters = {mu = {unit = "kPa", range = [5, 100]}}
constants = {lam = 60}
"""


def test_from_a_specimen_to_a_body_and_to_another_test_by_command(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "t.csv").write_text(TABLE)
    (tmp_path / "piece.toml").write_text(PIECE)
    (tmp_path / "body.toml").write_text(BODY)
    (tmp_path / "further.toml").write_text(PIECE.replace("t.csv", "u.csv"))
    (tmp_path / "u.csv").write_text("stretch_x,stress_x [kPa]\n1.0,0\n1.5,1\n")
    em.write_mesh(tmp_path / "own.vtu", em.generators.box((40.0, 10.0, 10.0), (4, 1, 1)))
    words = ["--data", "t.csv", "--noise", "0.5", "--sampler", "laplace", "--draws", "100"]
    words += ["--no-certify", "--out", "r", "--json"]
    assert main(["infer", "piece.toml", *words]) == 0
    mu = json.loads(capsys.readouterr().out)["parameters"]["mu"]
    assert abs(mu["mean"] - 30.0) < 3.0 * mu["sd"]
    ask = ["predict", "r", "--scene"]
    assert main([*ask, "further.toml", "--observe", "stress:stress_x", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    row = list(told["numbers"].values())[1]
    assert row["mean"] == pytest.approx(mu["mean"] * (1.5 - 1.5**-2), rel=1e-3)
    assert row["sd"] == pytest.approx(mu["sd"] * (1.5 - 1.5**-2), rel=0.1)
    (beyond,) = told["beyond"]
    assert beyond["share"] == 0.5
    assert beyond["learned"] == pytest.approx([3.0, 1.2**2 + 2.0 / 1.2])
    assert beyond["reached"] == pytest.approx([3.0, 1.5**2 + 2.0 / 1.5])
    words = ["--observe", "nodes:4", "--draws", "60", "--out", "p"]
    assert main([*ask, "body.toml", *words]) == 0
    out = capsys.readouterr().out
    assert "mu: the posterior" in out
    assert "verdict on the posterior: not certified" in out
    for name in ("prediction.nc", "prediction.json", "bands.png", "body.vtu"):
        assert (tmp_path / "p" / name).stat().st_size > 0
    refused = (
        ([*ask, "body.toml"], "say what to predict with --observe"),
        ([*ask, "body.toml", "--observe", "volume"], "0 cavities"),
        (["predict", "r", "--draws", "9"], "--draws has no effect without --scene"),
        (["predict", "r", "--another", "0.3"], "--another has no effect without --scene"),
        ([*ask, "body.toml", "--observe", "nodes:4", "--another", "heart"], "give a tissue"),
        (["predict", "r"], "r is a folder of infer: name the scene that it predicts, --scene"),
        ([*ask, "none.toml", "--observe", "nodes:4"], "none.toml"),
        (["predict", "q", "--scene", "body.toml", "--observe", "nodes:4"], "q"),
        ([*ask, "body.toml", "--observe", "nodes:4", "--theta", "mu=3"], "the posterior infers it"),
    )
    for line, words in refused:
        assert main(line) == 2
        complaint = capsys.readouterr().err
        assert words in complaint
        assert complaint.count("\n") == 1


def test_another_specimen_is_as_much_stiffer_in_all_its_moduli(posterior, shorter):
    """Stiffness differs by the scatter of both, and a specimen's ratios stay its own."""
    learned, rng = Learned.of(posterior), np.random.default_rng(3)
    other = learned.of_another_specimen(0.4, rng)
    factor = np.log(other.draws["mu"] / learned.draws["mu"])
    np.testing.assert_allclose(np.log(other.draws["lam"] / learned.draws["lam"]), factor)
    assert factor.std() == pytest.approx(np.sqrt(2.0) * 0.4, rel=0.1)
    tip = cal.nodal_displacements(shorter, "right")
    same = predict_on(posterior, shorter, tip, draws=100)
    wide = predict_on(posterior, shorter, tip, draws=100, another=0.4)
    assert "for another specimen" in wide.sources["mu"]
    sunk = [np.log(np.abs(p.values["displacement"][:, 0, 2])).std() for p in (same, wide)]
    assert sunk[1] > 3.0 * sunk[0]


@pytest.mark.parametrize("log_sd", [0.0, -0.4, np.nan, np.inf])
def test_a_scatter_that_is_none_is_refused(posterior, log_sd):
    with pytest.raises(InputError, match="give one above 0"):
        Learned.of(posterior).of_another_specimen(log_sd, np.random.default_rng(0))


def test_what_cannot_scatter_is_refused(posterior):
    learned, rng = Learned.of(posterior), np.random.default_rng(0)
    with pytest.raises(InputError, match="scatter already"):
        replace(learned, bodies=2 * learned.bodies).of_another_specimen(0.4, rng)
    with pytest.raises(InputError, match="no modulus"):
        replace(learned, draws={"pressure": np.ones(3)}).of_another_specimen(0.4, rng)


def test_a_scatter_is_named_by_its_tissue_or_a_number():
    assert scatter_of("myocardium") == 0.55
    assert scatter_of("0.3") == 0.3
    with pytest.raises(InputError, match="give a tissue"):
        scatter_of("heart")
