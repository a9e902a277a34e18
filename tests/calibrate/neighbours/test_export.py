"""Posteriors as cards of other programs: what is written, and what is refused in one line."""

import csv
import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import emulator as em
from calibrate.cli import main
from calibrate.neighbours import export_posterior
from calibrate.neighbours.export import body_of
from calibrate.project import read_posterior
from card_support import ENERGIES, stress
from cli_support import answer, complaint
from emulator.catalogue import find_problem
from emulator.core.errors import InputError
from emulator.mechanics.laws import LAWS
from emulator.neighbours.cards import PROGRAMS
from emulator.scenes.parameter_space import Parameter

INFER = (
    "infer once_clamped_beam --observe nodes:8 --noise 0.2 --truth mu=70 lam=80 --no-certify "
    "--sampler laplace --draws 30 --chains 2 --out"
)
EXTERNAL = """
[solver]
kind = "python"
function = "bar.py:solve"
[parameters.k]
unit = "N/mm"
median = 2.0
log_sd = 1.0
[outputs.extension]
unit = "mm"
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run on the beam, whose law is neo-Hookean: 60 draws."""
    folder = tmp_path_factory.mktemp("runs") / "beam"
    assert main([*INFER.split(), str(folder), "--json"]) == 0
    return folder


def columns(folder):
    with (folder / "parameters.csv").open() as file:
        return {
            row.pop("card"): {n: float(v) for n, v in row.items()} for row in csv.DictReader(file)
        }


def test_mean_median_and_draws_become_cards(run, tmp_path, capsys):
    out = tmp_path / "new" / "cards"
    code, result = answer(capsys, "export", run, "--to", "febio", "--out", out, "--draws", 3)
    assert code == 0
    cards = ["mean", "median", "draw_001", "draw_002", "draw_003"]
    names = [*(f"{card}.feb" for card in cards), "parameters.csv", "README.md"]
    assert result["files"] == names
    assert sorted(path.name for path in out.iterdir()) == sorted(names)
    draws, written = read_posterior(run)[1].draws(), columns(out)
    assert list(written) == cards
    for name, values in draws.items():
        expected = [values.mean(), np.median(values), *values[[0, 30, 59]]]
        np.testing.assert_allclose([written[card][name] for card in cards], expected, rtol=1e-12)
    F, law = np.eye(3) + 0.1 * np.arange(9.0).reshape(3, 3) / 9, LAWS["neo_hookean"]
    for card in cards:
        energy = ENERGIES["febio"]((out / f"{card}.feb").read_text(), np.eye(3))
        J, inverse, v = np.linalg.det(F), np.linalg.inv(F).T, written[card]
        ours = v["mu"] * (F - inverse) + v["lam"] * np.log(J) * inverse
        np.testing.assert_allclose(stress(energy, F), ours, rtol=1e-9)
    text = (out / "README.md").read_text()
    assert "FEBio 4: law 'neo_hookean'" in text
    assert f"({', '.join(f'{q.name} kPa' for q in law.quantities)})" in text
    assert "Nothing: the energies are equal." in text


def test_the_body_goes_along(run, tmp_path, capsys):
    words = ["export", run, "--to", "felupe", "--out", tmp_path / "out", "--draws", 0, "--mesh"]
    assert main(list(map(str, words))) == 0
    said = capsys.readouterr().out
    assert "law 'neo_hookean' for felupe: 6 files in" in said
    assert "the energies are equal" in said
    with np.load(tmp_path / "out" / "body.npz") as body:
        scene = read_posterior(run)[1].model.forward.scene
        np.testing.assert_array_equal(body["cells"], scene.mesh.elements)
        np.testing.assert_array_equal(body["nodes left"], scene.mesh.node_set("left"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--to ansys", "program 'ansys' is unknown; known: febio, abaqus, felupe, pulse"),
        ("--to calculi", "did you mean 'calculix'?"),
        (
            "--to abaqus",
            "Abaqus cannot take law 'neo_hookean': its neo-Hookean energy is isochoric",
        ),
        ("--to febio --draws 61", "61 draws, but the posterior has 60; give 60 or fewer"),
        ("--to febio --draws -1", "-1 draws; give 0 or more"),
        ("--to febio --draws many", "--draws: invalid int value: 'many'"),
        ("", "--to"),
    ],
)
def test_bad_words(run, words, message, tmp_path, capsys):
    said = complaint(capsys, "export", run, *words.split(), "--out", tmp_path / "out")
    assert message in said
    assert list(tmp_path.iterdir()) == []


def test_bad_folders(run, tmp_path, capsys):
    (tmp_path / "there").mkdir()
    words = ("--to", "febio", "--out")
    said = complaint(capsys, "export", run, *words, tmp_path / "there")
    assert said.endswith("there exists; name a folder that does not")
    said = complaint(capsys, "export", tmp_path / "none", *words, tmp_path / "out")
    assert "run.json does not exist: there is no such folder" in said
    (tmp_path / "run.json").write_text(json.dumps({"members": {"a": {}}}))
    said = complaint(capsys, "export", tmp_path, *words, tmp_path / "out")
    assert "holds a population; name one of its members" in said
    assert not (tmp_path / "out").exists()


def of_scene(monkeypatch, scene, **draws):
    """Let every run have the posterior ``draws`` of a scene."""
    entries = tuple(name if name in draws else float(scene.centre[k])
                    for k, name in enumerate(scene.parameter_names))  # fmt: skip
    from calibrate.statistical_model.load_states import LoadStates

    model = SimpleNamespace(
        forward=SimpleNamespace(scene=scene),
        full=SimpleNamespace(incompressible=True),
        states=LoadStates(("",), (entries,)),
    )
    posterior = SimpleNamespace(model=model, draws=lambda: draws)
    monkeypatch.setattr("calibrate.neighbours.export.read_posterior", lambda run: (run, posterior))


def test_a_run_without_a_law_is_refused(tmp_path, monkeypatch):
    (tmp_path / "bar.py").write_text("def solve(k):\n    return {'extension': 1.0 / k}\n")
    (tmp_path / "bar.toml").write_text(EXTERNAL)
    of_scene(monkeypatch, find_problem(str(tmp_path / "bar.toml")), k=np.array([1.0, 2.0]))
    with pytest.raises(InputError, match="needs a law, and problem 'bar' is solved by another"):
        export_posterior("run", "febio", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_regions_are_refused(tmp_path, monkeypatch):
    scene = em.scenes.once_clamped_beam(cells=(3, 1, 1), order=1)
    regions = np.arange(len(scene.mesh.elements)) % 2
    factors = tuple(Parameter(f"stiffness_{k}", "", 0.5, 2.0) for k in (0, 1))
    parameters = (*scene.parameters, *factors)
    scene = replace(scene, regions=regions, parameters=parameters, origin={})
    of_scene(monkeypatch, scene, mu=np.array([60.0, 70.0]))
    with pytest.raises(InputError, match="has regions; cards are of one material"):
        export_posterior("run", "felupe", tmp_path / "out", draws=1)


def test_the_readme_says_what_differs(ventricle, tmp_path, monkeypatch):
    """Of a ventricle: the penalty, the switch, fibres, and a bulk modulus that no data saw."""
    of_scene(monkeypatch, ventricle, a=np.array([0.2, 0.4, 0.3]))
    export_posterior("run", "svmultiphysics", tmp_path / "out", draws=1, mesh=True)
    text = (tmp_path / "out" / "README.md").read_text()
    assert "- Fibres are switched off in compression by a smooth function, k = 1000" in text
    assert "- The data were taken as incompressible: the bulk modulus was not calibrated." in text
    written = columns(tmp_path / "out")
    assert written["median"]["a"] == 0.3
    assert written["median"]["kappa"] == ventricle.constants["kappa"]
    guccione, ranges = LAWS["guccione"], {"C": (1.0, 2.0), "kappa": (1e3, 2e3)}
    parameters = (
        Parameter(q.name, q.unit, *ranges.get(q.name, (1.0, 4.0)))
        for q in (*guccione.quantities, *ventricle.loads[0].quantities)
    )
    changes = {"parameters": tuple(parameters), "constants": {}, "origin": {}}
    of_scene(monkeypatch, replace(ventricle, law=guccione, **changes), C=np.array([1.5]))
    export_posterior("run", "febio", tmp_path / "guccione", draws=0)
    text = (tmp_path / "guccione" / "README.md").read_text()
    assert "- Volume: FEBio 4 has k/2 (ln J)^2, with our bulk modulus at rest" in text


def test_fibres_of_elements_are_those_of_the_scene(ventricle):
    body, theta = body_of(ventricle, ventricle.centre), ventricle.centre
    np.testing.assert_allclose(body.fibres, ventricle.fibres_at(theta)[:, 0], atol=1e-12)
    quadratic = em.scenes.left_ventricle(rings=2, around=6, layers=1)
    body = body_of(quadratic, quadratic.centre)
    np.testing.assert_allclose(np.linalg.norm(body.fibres, axis=1), 1.0)
    cosines = np.einsum("mqi,mi->mq", quadratic.fibres_at(quadratic.centre), body.fibres)
    assert np.median(np.abs(cosines)) > 0.9


def test_every_program_says_how_its_cards_are_used():
    for program in PROGRAMS.values():
        assert program.usage.endswith(".")
        assert program.units.startswith(("mm", "kg, mm"))
