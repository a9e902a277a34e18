"""A new forward map is its own file and one line of the registry: nothing else must know it."""

import json
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from calibrate.cli import main
from calibrate.posterior import read_tree
from calibrate.project import simulator_of
from emulator.scenes.built_in import BUILT_IN
from emulator.scenes.scene import all_nodes
from emulator.surrogates import save_emulator
from emulator.surrogates.protocol import ForwardKind, Option, fingerprint_of, inside_only
from emulator.surrogates.registry import FORWARD_MAPS
from network_support import untrained

SCENE = "once_clamped_beam"


# What a new file would hold: a map, and its kind.
@dataclass(frozen=True, eq=False)
class Polynomial:
    """Taylor polynomial of FEM at the centre of the box, in theta."""

    scene: object
    nodes: np.ndarray
    terms: tuple

    kind = "polynomial"

    @property
    def label(self):
        return f"polynomial of order {len(self.terms) - 1}"

    @property
    def fingerprint(self):
        return fingerprint_of(self.kind, self.scene.fingerprint, self.nodes, *self.terms)

    def __call__(self, theta):
        step = theta - self.scene.centre
        u = self.terms[0]
        return u if len(self.terms) == 1 else u + jnp.tensordot(step, self.terms[1], axes=1)

    def evaluate(self, theta):
        return inside_only(self, theta)

    def at(self, nodes):
        return replace(self, nodes=nodes, terms=tuple(t[..., nodes, :] for t in self.terms))


def build(made_of, options):
    centre = made_of.scene.centre
    u = made_of.simulator.solve(centre).displacement
    terms = (u, made_of.simulator.sensitivities(u, centre))[: options["order"] + 1]
    return made_of.ranged(Polynomial(made_of.scene, all_nodes(made_of.scene), terms))


KIND = ForwardKind(
    "polynomial", "derivatives of FEM", build, (Option("order", 1, "order", least=0),)
)


@pytest.fixture(scope="module", autouse=True)
def setting():
    """The one line of the registry; and a coarse beam under the built-in one's name."""
    scene = em.scenes.once_clamped_beam(cells=(4, 1, 1), order=1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(FORWARD_MAPS, KIND.name, KIND)
        patch.setitem(BUILT_IN, SCENE, lambda **_: scene)
        yield scene


def answer(capsys, *words):
    code = main([*map(str, words), "--json"])
    captured = capsys.readouterr()
    assert not captured.err
    return code, json.loads(captured.out)


@pytest.mark.slow
def test_it_is_evaluated(setting, tmp_path, capsys):
    save_emulator(untrained(setting), tmp_path)
    words = ["evaluate", tmp_path, "--against", "fem", "--cases", 3]
    code, report = answer(capsys, *words, "--forward", "polynomial", "--order", 1)
    assert code == 0
    assert (report["forward"], report["forward_options"]) == ("polynomial", {"order": 1})
    assert report["label"] == "polynomial of order 1"
    assert report["err_u"]["median"] < 0.2 * report["mean_u"]["median"]


@pytest.mark.slow
def test_it_is_inferred_with_and_certified(tmp_path, capsys):
    words = ["infer", SCENE, "--truth", "mu=75", "lam=60", "--observe", "nodes:3", "--noise", "9"]
    words += ["--forward", "polynomial", "--order", 1, "--warmup", 40, "--draws", 40]
    words += ["--chains", 2, "--no-certify", "--out", tmp_path]
    code, report = answer(capsys, *words)
    assert (code, report["forward"]) == (0, "polynomial")
    run = json.loads((tmp_path / "run.json").read_text())
    assert (run["forward"], run["forward_options"]) == ("polynomial", {"order": 1})
    attributes = read_tree(tmp_path / "posterior.nc").attrs
    scene = BUILT_IN[SCENE]()
    made = build(SimpleIngredients(scene), {"order": 1})
    assert attributes["forward_fingerprint"] == made.fingerprint
    code, report = answer(capsys, "certify", tmp_path, "--draws", 25)
    assert report["certificate"]["failed"] == 0


@pytest.mark.parametrize("command", [("evaluate", "x", "--against", "fem"), ("infer", SCENE)])
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--order", "2"], "--order has no effect without --forward polynomial"),
        (["--fem-runs", "9"], "--fem-runs has no effect without --forward reduced"),
        (["--forward", "polynomial", "--steps", "2"], "--steps has no effect without --forward co"),
        (["--forward", "polynomial", "--order", "-1"], "order is -1; it must be 0 or more"),
        (["--forward", "spline"], "fem, homogeneous, incompressible, rows, polynomial"),
    ],
)
def test_its_options_are_checked_everywhere(tmp_path, capsys, command, words, message):
    assert main([*command, *words, "--out", str(tmp_path / "r")]) == 2
    said = capsys.readouterr().err
    assert message in said.replace("'", "")
    assert said.count("\n") == 1
    assert not (tmp_path / "r").exists()


@dataclass
class SimpleIngredients:
    scene: object

    @property
    def simulator(self):
        return simulator_of(self.scene)

    def ranged(self, forward):
        return forward
