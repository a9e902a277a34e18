"""The page of a posterior: what it says, that it needs no network, and that a browser shows it."""

import re

import numpy as np
import plotly.graph_objects as go
import pytest

import calibrate as cal
import emulator as em
from browser_support import opened
from calibrate.measurements import CavityVolume, Observations, landmarks, spread_landmarks
from calibrate.project import Run
from calibrate.report import charts
from calibrate.report.body import body_figure
from calibrate.report.page import html_of
from calibrate.samplers.laplace import LaplaceOptions
from emulator.specimens.states import states

pytestmark = pytest.mark.slow  # compiling for a ventricle; test_command.py is quick

TINY = LaplaceOptions(draws=60, chains=2, starts=2)
CERTIFICATE = {
    "verdict": "accepted",
    "findings": ["no mean moves <b>"],
    "reason": "",
    "k_hat": 0.1,
    "k_threshold": 0.49,
    "draws": 200,
    "failed": 0,
    "mesh": {"runs": 9},
}


@pytest.fixture(scope="module")
def ventricle_posterior():
    """Of the shipped ventricle, 6 landmarks and the volume in one load state."""
    emulator = em.load("left_ventricle")
    scene = emulator.scene
    parts = {
        "displacement": landmarks(scene, spread_landmarks(scene, 6, 0)),
        "volume": CavityVolume(scene),
    }
    forward = emulator.cache()
    model = cal.model(forward, Observations(parts), {n: cal.GaussianNoise(sd=1.0) for n in parts})
    u = forward(scene.centre)[model.observe.nodes]
    data = model.observe(u[None], scene.centre[None])
    return cal.sample(model, data, sampler="laplace", options=TINY, seed=0)


@pytest.fixture(scope="module")
def page(ventricle_posterior):
    return html_of(Run("left_ventricle"), ventricle_posterior, CERTIFICATE, fem=False)


def test_the_verdict_comes_first_and_all_sections_follow(page):
    order = [
        "<b>accepted</b>",
        "Data against prediction",
        "Parameters",
        "The body",
        "What the data determine",
        "Draws",
        "how to repeat it",
    ]
    body = page[page.index("</head>") :]
    places = [body.index(word) for word in order]
    assert places == sorted(places)
    assert "no mean moves &lt;b&gt;" in page  # text, not markup
    assert "a_f (kPa)" in page
    assert "log-uniform, 0.2 to 0.52" in page


def test_the_verdict_says_by_what(ventricle_posterior):
    run = Run("left_ventricle", data="u.csv")
    text = html_of(run, ventricle_posterior, CERTIFICATE, fem=False, certificate_day="2026-01-02.")
    assert "Judged by 200 FEM runs, 0 failed, and 9 on a finer mesh. Pareto k 0.10, at most" in text
    assert "Limits: 0.25 sd for a mean, 0.5 on a finer mesh, 20 % for an sd." in text
    assert "Data: u.csv. 2026-01-02." in text
    unknown = CERTIFICATE | {"k_hat": None, "mesh": {}}
    text = html_of(run, ventricle_posterior, unknown, fem=False)
    assert "Judged by 200 FEM runs, 0 failed. Limits" in text


def test_where_it_comes_from_is_in_words_and_whole(page):
    told = page[page.index("how to repeat it") :]
    assert "a: LogUniform(low=" in told
    assert not re.search(r"<td>(null|inf|None|\{\})</td>|\.\.\.</td>", told)
    assert "observe" not in told  # as usual; where data is a file it says nothing


def test_it_needs_no_network(page):
    body = page[page.index("</head>") :]
    assert not re.search(r"<(script|link|img)[^>]*\s(src|href)=", page[: page.index("<style>")])
    assert not re.search(r"<(script|link|img)[^>]*\s(src|href)=", body)
    assert page.count("<!DOCTYPE html>") == 1


def test_without_a_certificate_it_says_so(ventricle_posterior):
    text = html_of(Run("left_ventricle"), ventricle_posterior, None, fem=False)
    assert "<b>not certified</b>" in text
    assert "run calibrate certify" in text


def test_the_body_deforms_by_the_draws(ventricle_posterior):
    figure = body_figure(ventricle_posterior, None)
    scene = ventricle_posterior.model.forward.scene
    assert [step.label for step in figure.layout.sliders[0].steps][:2] == ["mean", "draw 1"]
    mean = np.asarray(ventricle_posterior.model.full(scene.centre))
    nodes = np.unique(scene.mesh.surface)
    shown = np.stack([figure.data[0][axis] for axis in "xyz"], axis=1)
    # Near the data's truth; nothing else has been seen.
    assert np.abs(shown - scene.mesh.nodes[nodes] - mean[nodes]).max() < 2.0
    draws = [np.asarray(frame.data[0].z) for frame in figure.frames[1:]]
    assert len(draws) == 20
    assert np.std(draws, axis=0).max() > 1e-3
    menu = [button.label for button in figure.layout.updatemenus[0].buttons]
    assert menu == [
        "mean displacement (mm)",
        "sd of displacement (mm)",
        "largest principal strain",
        "fibre stretch",
    ]
    at_rest = figure.data[1]
    assert np.asarray(at_rest.z).shape == (len(nodes),)
    assert figure.data[2].name == "fibres"


def curve_rest(posterior):
    return float(cal.CavityVolume(posterior.model.forward.scene).cavity.rest)


def test_charts_say_what_was_drawn(ventricle_posterior):
    named = dict(charts.against_data(ventricle_posterior))
    assert set(named) == {"displacement", "volume"}
    assert len(named["displacement"].data[1].x) == 18
    curve = charts.volume_band(ventricle_posterior)
    klotz, _, median, unloaded, seen = curve.data
    assert (np.diff(median.x) > 0.0).all()  # a stiffer pressure, a larger cavity
    assert (unloaded.x[0], unloaded.y[0]) == (curve_rest(ventricle_posterior), 0.0)
    assert unloaded.x[1] == median.x[0] > unloaded.x[0]
    assert median.text[-1].endswith(f"({median.y[-1] / 0.133322:.3g} mmHg)")
    assert seen.x[0] == pytest.approx(float(ventricle_posterior.data["volume"]))
    # Klotz's curve lies behind, through what was measured.
    assert np.interp(seen.y[0], klotz.y, klotz.x) == pytest.approx(seen.x[0], rel=1e-3)
    assert klotz.x[0] == pytest.approx(seen.x[0] * (0.6 - 0.006 * seen.y[0] / 0.133322), rel=1e-6)
    labels = charts.names_with_units(ventricle_posterior)
    draws = {name: np.asarray(ventricle_posterior.tree["posterior"][name]) for name in labels}
    traces = charts.traces(labels, draws, ventricle_posterior.model.sampled_priors).data
    ranks = [t for t in traces if t.type == "scatter" and t.line.shape]
    assert len(ranks) == 2 * 5
    priors = [t for t in traces if t.name == "prior"]
    assert len(priors) == 5
    a = priors[0]
    np.testing.assert_allclose(a.y, 1.0 / (np.array(a.x) * np.log(0.52 / 0.2)), rtol=1e-6)
    assert sum(ranks[0].y[:-1]) == 60
    assert isinstance(charts.stress(ventricle_posterior), go.Figure)


def test_two_load_states_have_an_ejection_fraction(ventricle_posterior):
    """By hand, of draws that know each state's pressure; one state has none."""
    forward = ventricle_posterior.model.full
    scene, seen = forward.scene, CavityVolume(forward.scene)
    model = cal.model(
        forward,
        {"volume@full": seen, "volume@empty": seen},
        {name: cal.GaussianNoise(sd=1.0) for name in ("volume@full", "volume@empty")},
        known={"pressure@full": 1.2, "pressure@empty": 0.6},
    )
    volume = lambda p: float(seen.cavity(forward.at(seen.nodes)(scene.centre.at[4].set(p))))
    data = {"volume@full": volume(1.2), "volume@empty": volume(0.6)}
    posterior = cal.sample(model, data, sampler="laplace", options=TINY, seed=0)
    volumes = charts.state_volumes(posterior)
    assert list(volumes) == ["full", "empty"]
    thetas = posterior.thetas("full")
    by_hand = float(seen.cavity(forward.at(seen.nodes)(thetas[0])))
    assert volumes["full"][0] == pytest.approx(by_hand)
    text = html_of(Run("left_ventricle"), posterior, CERTIFICATE, fem=False)
    found = re.search(r"smaller in empty than in full by ([0-9.]+) \(", text)
    expected = 100.0 * (1.0 - np.median(volumes["empty"] / volumes["full"]))
    assert float(found[1]) == pytest.approx(expected, abs=0.1)
    assert charts.state_volumes(ventricle_posterior) == {}
    figure = body_figure(posterior, None)
    assert figure.layout.updatemenus[1].buttons[0].args[0] == ("full", "empty")
    widths = {frame.name: np.ptp(np.asarray(frame.data[0].x)) for frame in figure.frames}
    assert widths["full"] > widths["empty"]  # inflated
    assert widths["empty"] == pytest.approx(widths["mean"], rel=1e-3)


def test_in_a_browser(page, tmp_path):
    """The slider moves the mesh, and nothing complains or calls out."""
    path = tmp_path / "page.html"
    path.write_text(page, encoding="utf-8")
    find = "[...document.querySelectorAll('.js-plotly-plot')].find(d => d.layout.sliders)"
    with opened(path.as_uri()) as (shown, complaints):
        shown.wait_for_selector(".slider-rail-touch-rect")
        place = f"JSON.stringify({find}.data[0].z.slice(0, 50))"
        before = shown.evaluate(place)
        box = shown.query_selector(".slider-rail-touch-rect").bounding_box()
        shown.mouse.click(box["x"] + 0.8 * box["width"], box["y"] + 0.5 * box["height"])
        shown.wait_for_function(f"{find}.layout.sliders[0].active > 10")
        shown.wait_for_function(f"before => {place} !== before", arg=before)
        assert complaints == []


def test_the_page_of_a_specimen_says_which_terms_its_law_needs():
    stretch = np.tile(np.linspace(1.02, 1.3, 4), 2)
    scene = em.specimen(
        states({"stretch_x": stretch, "stretch_y": stretch}, ["first"] * 4 + ["second"] * 4),
        law=em.find_law("mooney_rivlin"),
        parameters=tuple(em.Parameter(f"c_{k}", "kPa", 0.01, 20.0) for k in ("10", "01")),
        constants={"kappa": 1000.0},
    )
    forward = em.homogeneous(scene, incompressible=True)
    model = cal.model(forward, cal.stresses(scene, "stress_x,stress_y"), cal.GaussianNoise(sd=0.1))
    exact = np.asarray(model.predict({"c_10": 4.0, "c_01": 0.01})[0]["stress"])
    data = exact + 0.1 * np.random.default_rng(0).normal(size=exact.shape)
    posterior = cal.sample(model, data, sampler="laplace", options=TINY, seed=0)
    text = html_of(Run("biaxial.toml"), posterior, None, fem=False)
    assert "Which terms of the law" in text
    rows = dict(re.findall(r"<tr><td>(c_[01]+)</td><td>([0-9.]+)</td>", text))
    assert float(rows["c_10"]) > 0.95
    assert float(rows["c_01"]) < 0.5
    assert "Each test left out in turn: each test is predicted by the others; no other set" in text
    assert re.search(r"<tr><td>second</td><td>8</td><td>[0-9.]+ %</td>", text)
