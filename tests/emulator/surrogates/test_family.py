"""A network that has learned a family of ventricles, on one it has not seen."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import emulator as em
from emulator.core.checkpoint import Checkpoint
from emulator.core.errors import InputError
from emulator.core.units import MM3_PER_ML
from emulator.fem.linear_response import (
    BULK,
    FIBRES,
    MATRIX,
    linear_responses,
    pressure_force,
)
from emulator.geometry.facets import Cavity
from emulator.geometry.io import write_mesh
from emulator.geometry.mesh import Mesh
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.scene import Scene
from emulator.surrogates import Emulator, load, save_emulator
from emulator.surrogates.network.body import _nodal_means, _nodal_volumes, describe
from emulator.surrogates.network.family import FamilyNetwork
from emulator.surrogates.network.graph import AugmentedGraph
from emulator.surrogates.network.pignn import Architecture, Processor
from emulator.surrogates.taylor import constant
from emulator.training import families as ventricles
from emulator.training import recipe, train
from emulator.training.families import BodyRuns, FamilyPlan, family_of, train_family
from emulator.training.job import Job
from emulator.training.mechanics import Mechanics, prepare

SMALL = Architecture(
    steps=2, latent=8, hidden=(16,), decoder="separable", modes=4, trunk=(16,), branch=(16,)
)
SHAPES = (
    {"rings": 3, "around": 8, "layers": 1},
    {"rings": 4, "around": 8, "layers": 1, "thicker": (0.2, 50.0)},
    {"rings": 3, "around": 9, "layers": 1, "angles": (50.0, -50.0)},
)


SCENE = """
law = "holzapfel_ogden"
mesh = "mine.vtu"
[fibres]
rule = "helix"
angles = [65.0, -55.0]
[[supports]]
node_set = "base"
[[loads]]
kind = "cavity_pressure"
facet_set = "endocardium"
[constants]
kappa = 25.0
"""
PARAMETER = """
[parameters.{name}]
unit = "{unit}"
range = [{low}, {high}]
scale = "{scale}"
"""


def body(**shape: object) -> Scene:
    """A ventricle whose pressure begins at zero."""
    scene = em.scenes.left_ventricle(**shape)
    pressure = replace(scene.parameters[-1], low=0.0)
    return replace(scene, parameters=(*scene.parameters[:-1], pressure), origin={})


def runs(scene: Scene) -> BodyRuns:
    """Made-up runs: a ventricle that widens with the pressure and with its softness."""
    position = np.random.default_rng(0).random((4, 5))
    held = scene.held.all(axis=1)
    outwards = ~held[:, None] * scene.mesh.nodes * [1.0, 1.0, 0.0]
    pressure, softness = position[:, 4], 2.0 - position[:, 2]
    rates = np.zeros((4, 5))
    rates[:, 2], rates[:, 4] = -0.1 * pressure, 0.1 * softness
    return BodyRuns(
        features=describe(scene),
        mesh=scene.mesh,
        held=held,
        position=position,
        displacement=(0.1 * pressure * softness)[:, None, None] * outwards,
        slopes=rates[:, :, None, None] * outwards,
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("family")


@pytest.fixture(scope="module")
def bodies() -> list[BodyRuns]:
    return [runs(body(**shape)) for shape in SHAPES]


@pytest.fixture(scope="module")
def family(folder: Path, bodies: list[BodyRuns]) -> Emulator:
    home = body(**SHAPES[0])
    plan = replace(FamilyPlan(), steps=150, learning_rate=3e-3)
    return train_family(family_of(bodies, home, SMALL), "made up", plan, folder, home)


def on(family: Emulator, scene: Scene) -> Emulator:
    """The family's network on ``scene``, whatever its shape."""
    assert family.family is not None
    return Emulator(scene, family=replace(family.family, scene=scene))


def test_it_learns_and_takes_it_to_a_body_unseen(family: Emulator) -> None:
    scene = body(rings=4, around=8, layers=1, thicker=(0.1, 200.0))
    unseen = runs(scene)
    predicted = on(family, scene).cache()(scene.from_unit(jnp.asarray(unseen.position)))
    left = np.linalg.norm(predicted - unseen.displacement)
    assert left < 0.5 * np.linalg.norm(unseen.displacement)


def test_without_pressure_nothing_moves(family: Emulator) -> None:
    position = jnp.asarray([0.3, 0.6, 0.2, 0.8, 0.0])
    assert not np.any(family.cache()(family.scene.from_unit(position)))


def test_padding_changes_nothing(family: Emulator, bodies: list[BodyRuns]) -> None:
    """What training sees of a padded body is what is predicted on it."""
    assert family.family is not None
    learned, told = family.family.learned, bodies[0].features
    sizes = ventricles._Sizes.of(bodies)._replace(nodes=900, elements=800)
    sizes = sizes._replace(regions=sizes.regions + 7, edges=sizes.edges + 5)
    padded = ventricles._prepared(bodies[0], learned.standard, sizes, np.random.default_rng(0))
    graph = AugmentedGraph(**padded.inputs.graph, real=sizes.regions)
    part = FamilyNetwork(learned, body(**SHAPES[0]))
    (module,) = part._modules()
    modes, summary = module.prepare(padded.inputs._replace(graph=graph))
    own_modes, (own_summary,) = part._prepare()
    size, count = learned.scale * told.size, len(told.local)
    # Edges were turned round, which a network not yet trained for long minds a little.
    assert np.allclose(summary, own_summary, atol=0.3)
    assert np.abs(size * modes[:, :count] - own_modes).max() < 0.5 * np.abs(own_modes).max()
    assert not np.any(modes[:, count:])


def test_a_body_moved_turned_and_enlarged(family: Emulator) -> None:
    scene = body(rings=6, around=12, layers=2, thicker=(0.2, 40.0))
    R, scale = Rotation.from_rotvec([0.3, -0.5, 0.7]).as_matrix(), 1.3
    mesh = scene.mesh
    nodes = scale * mesh.nodes @ R.T + [5.0, 6.0, 7.0]
    moved = replace(
        scene,
        mesh=Mesh(nodes, mesh.elements, mesh.node_sets, mesh.facet_sets),
        fibres=scene.fibres @ R.T,
        origin={},
    )
    u, v = (on(family, each).cache()(each.centre) for each in (scene, moved))
    assert np.allclose(scale * u @ R.T, v, atol=1e-4 * np.abs(v).max())


def test_a_body_is_told_alike_on_a_coarser_and_a_finer_mesh() -> None:
    """But for what depends on its volume change, which elements of other sizes resist unlike."""
    shape = {"thicker": (0.2, 40.0)}
    coarse = describe(body(rings=7, around=20, layers=2, **shape))
    fine = describe(body(rings=10, around=28, layers=3, **shape))
    assert coarse.graph.real == fine.graph.real == 256 < len(coarse.local) // 4
    assert len(fine.local) > 2 * len(coarse.local)
    for name, value in coarse.numbers.items():
        if not name.endswith("3"):
            assert fine.numbers[name] == pytest.approx(value, abs=0.2), name
    for told in (coarse, fine):
        assert np.allclose(told.closeness.sum(axis=1), 1.0)
        assert told.shares.sum() == pytest.approx(1.0)
        # Regions are of one size, whatever the mesh.
        assert told.shares.max() < 4.0 / 256


def test_what_is_linear_in_a_body_is_exact_at_its_nodes() -> None:
    """Also on its surface, where a mean over elements would be their inside's."""
    grid = em.scenes.once_clamped_beam((3, 2, 2), order=2).discretisation
    nodes = grid.mesh.nodes
    at_points = np.einsum("qa,mai->mqi", grid.values, nodes[grid.connectivity])
    tensors = np.einsum("mqi,j->mqij", at_points, [1.0, -2.0, 3.0])[None]
    volume = _nodal_volumes(grid)
    found = _nodal_means(grid, tensors, volume)
    assert np.allclose(found[0], np.einsum("ni,j->nij", nodes, [1.0, -2.0, 3.0]))
    assert volume.sum() == pytest.approx(grid.weights.sum())


def test_linear_responses() -> None:
    """They meet the energy's own gradient, and one of them is a difference quotient."""
    scene = body(**SHAPES[1])
    grid, fibres = scene.discretisation, scene.fibres_at_points
    w, by_fibres, twice, by_bulk = linear_responses(grid, fibres, "endocardium", scene.held)

    def energy(u: jax.Array, fibre: float, bulk: float) -> jax.Array:
        H = jnp.einsum("mqai,maj->mqji", grid.gradients, u[grid.connectivity])
        strain = 0.5 * (H + jnp.swapaxes(H, -1, -2))
        trace = jnp.trace(strain, axis1=-2, axis2=-1)
        along = jnp.einsum("mqi,mqij,mqj->mq", fibres, strain, fibres)
        square = jnp.sum(strain**2, axis=(-2, -1))
        density = MATRIX * square + 0.5 * bulk * trace**2 + 2.0 * fibre * along**2
        return jnp.sum(grid.weights * density)

    forces = jax.jit(jax.grad(energy))
    pressure = -jax.jit(jax.grad(em.fem.energy.potential_energy(scene)))(
        jnp.zeros(scene.held.shape), scene.centre.at[-1].set(1.0)
    )
    free = ~scene.held
    assert np.allclose(forces(w, FIBRES, BULK)[free], pressure[free], atol=1e-7)
    # K dw = -(dK) w, for both moduli.
    for rate, of, moved in (
        (by_fibres, w, (1.0, 0.0)),
        (twice, by_fibres, (1.0, 0.0)),
        (by_bulk, w, (0.0, 1.0)),
    ):
        change = forces(of, FIBRES + moved[0], BULK + moved[1]) - forces(of, FIBRES, BULK)
        assert np.allclose(forces(rate, FIBRES, BULK)[free], change[free], atol=1e-7)


def test_the_force_of_a_pressure_is_the_slope_of_the_volume() -> None:
    scene = body(**SHAPES[1])
    u = 0.1 * ~scene.held * np.sin(scene.mesh.nodes)
    cavity = Cavity(scene.mesh, "endocardium")
    slope = jax.jit(jax.grad(cavity))(u[cavity.nodes]) * MM3_PER_ML
    force = pressure_force(scene.mesh, scene.mesh.nodes + u, "endocardium")[cavity.nodes]
    free = ~scene.held[cavity.nodes]
    assert np.allclose(force[free], slope[free], atol=1e-8)


def test_its_first_call_may_be_compiled(family: Emulator) -> None:
    """The body is described at the first call, which may be inside a trace."""
    theta = family.scene.centre
    fresh = on(family, family.scene)
    assert np.allclose(jax.jit(fresh)(theta), family(theta), atol=1e-5)
    assert np.allclose(fresh(theta), family(theta), atol=1e-6)


def test_several_members_are_averaged(family: Emulator, tmp_path: Path) -> None:
    assert family.family is not None
    (one,), scene = family.family.learned.members, family.scene
    other = jax.tree.map(lambda x: 0.8 * x, one)

    def of(*members: object) -> Emulator:
        learned = family.family.learned._replace(members=members)
        return Emulator(scene, family=FamilyNetwork(learned, scene))

    theta, both = scene.centre, of(one, other)
    mean = 0.5 * (of(one).cache()(theta) + of(other).cache()(theta))
    assert np.allclose(both.cache()(theta), mean, atol=1e-6)
    save_emulator(both, tmp_path / "both")
    assert np.allclose(load(tmp_path / "both", scene).cache()(theta), mean, atol=1e-6)


def test_what_was_learned_on_a_body_stays_on_it(family: Emulator, tmp_path: Path) -> None:
    """With another part beside it, the network is refused elsewhere: that part would be lost."""
    scene = family.scene
    series = constant(np.full(5, 0.5), jnp.zeros(scene.held.shape))
    save_emulator(replace(family, taylor=series), tmp_path / "it")
    with pytest.raises(InputError, match="was trained for a scene with fingerprint"):
        load(tmp_path / "it", body(**SHAPES[2]))


def test_cached_is_uncached_and_saved_is_loaded(family: Emulator, tmp_path: Path) -> None:
    theta = family.scene.from_unit(jnp.asarray([0.3, 0.6, 0.2, 0.8, 0.4]))
    u = family.cache()(theta)
    assert np.allclose(u, family(theta), atol=1e-5 * np.abs(u).max())
    save_emulator(family, tmp_path / "it")
    again = load(tmp_path / "it", family.scene)
    assert np.allclose(again.cache()(theta), u, atol=1e-6 * np.abs(u).max())
    assert again.fingerprint == family.fingerprint
    # On another body it is taken there, as long as that is like its own.
    other = body(**SHAPES[2])
    there = load(tmp_path / "it", other)
    assert np.allclose(there.cache()(theta), on(family, other).cache()(theta))
    fixed = {**other.constants, "b": 1.5}
    known = replace(
        other,
        constants=fixed,
        parameters=tuple(p for p in other.parameters if p.name != "b"),
        origin={},
    )
    assert np.allclose(
        load(tmp_path / "it", known).cache()(jnp.delete(theta, 1)),
        there.cache()(theta.at[1].set(1.5)),
    )


def test_a_resumed_training_is_the_uninterrupted_one(
    family: Emulator,
    folder: Path,
    bodies: list[BodyRuns],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    home, plan = family.scene, replace(FamilyPlan(), steps=150, learning_rate=3e-3)
    monkeypatch.setattr(Checkpoint, "keep", Checkpoint.write)

    def killed(state: object, _: int) -> None:
        if getattr(state, "done", 0) == 100:
            raise KeyboardInterrupt

    made = family_of(bodies, home, SMALL)
    with pytest.raises(KeyboardInterrupt):
        train_family(made, "made up", plan, tmp_path, home, after_step=killed)
    again = train_family(made, "made up", plan, tmp_path, home, resume=True)
    assert np.array_equal(again.cache()(home.centre), family.cache()(home.centre))
    with pytest.raises(InputError, match="another run: its bodies is made up, not others"):
        train_family(made, "others", plan, tmp_path, home, resume=True)


@pytest.mark.slow
def test_a_start_for_other_recipes(family: Emulator, tmp_path: Path) -> None:
    """With an FEM run it is the network plus what FEM's series adds."""
    scene = body(**SHAPES[0])
    plan = Mechanics(order=1, simulations=1)
    started, *_ = prepare(plan, Job(scene, start=family))
    u = em.Simulator(scene)(scene.centre)
    found = started.cache()
    assert np.allclose(found(scene.centre), u, atol=1e-5)
    # Its slopes at the centre are FEM's, too.
    slope = jax.jacfwd(found)(scene.centre)
    exact = jnp.moveaxis(em.Simulator(scene).sensitivities(u, scene.centre), 0, -1)
    assert np.abs(slope - exact).max() < 1e-3 * np.abs(exact).max()
    # Resumed, it is asked for again: the checkpoint of a training without a network has no weights.
    whole = train(scene, plan, tmp_path, start=family)
    with pytest.raises(InputError, match="stands on another emulator than is given"):
        train(scene, FamilyPlan(), tmp_path, resume=True)
    again = train(scene, plan, tmp_path, start=family, resume=True)
    assert again.fingerprint == whole.fingerprint


def test_what_it_cannot_take(family: Emulator, tmp_path: Path) -> None:
    assert family.family is not None
    scene = family.scene
    mesh = scene.mesh
    metres = replace(
        scene,
        mesh=Mesh(1e-3 * mesh.nodes, mesh.elements, mesh.node_sets, mesh.facet_sets),
        origin={},
    )
    pressures = (*scene.parameters[:4], Parameter("pressure", "kPa", 0.1, 5.0))
    others = (
        (metres, "its size is 0.0.* are its coordinates in mm"),
        (replace(scene, parameters=pressures, origin={}), "pressure ranges from 0.1 to 5 kPa"),
        (em.scenes.left_ventricle(3, 8, 1, kappa=50.0), "constants: "),
        (em.scenes.left_ventricle(4, 8, 1, order=1), "order of elements: 1"),
        (em.scenes.left_ventricle(3, 8, 1, angles=("endo", "epi")), "its theta is .*endo"),
        (em.scenes.left_ventricle_neo_hookean(3, 8, 1), "its theta is lam, mu, pressure"),
        (em.scenes.once_clamped_beam((4, 2, 2)), "its theta is lam, mu"),
        (em.scenes.biventricle(4, 12, (1, 1)), "constants: "),
    )
    for other, words in others:
        with pytest.raises(InputError, match=words):
            family.family.on(other)
    with pytest.raises(InputError, match="trains its network from nothing, so it has no start"):
        train(scene, recipe("paper"), tmp_path, start=family)


def test_no_fibres() -> None:
    scene: Scene = em.scenes.left_ventricle_neo_hookean(3, 8, 1)
    with pytest.raises(InputError, match="has no fibres"):
        describe(scene)


def test_bodies_that_do_not_belong_together(bodies: list[BodyRuns]) -> None:
    home = body(**SHAPES[0])
    fewer = bodies[1]._replace(position=bodies[1].position[:3])
    with pytest.raises(InputError, match="other numbers of runs"):
        family_of([bodies[0], fewer], home, SMALL)
    with pytest.raises(InputError, match="no body"):
        family_of([], home, SMALL)
    with pytest.raises(InputError, match="does not begin at zero"):
        family_of(bodies, em.scenes.left_ventricle(3, 8, 1), SMALL)


def test_the_processor_runs_once(family: Emulator, monkeypatch: pytest.MonkeyPatch) -> None:
    runs, call = [], Processor.__call__
    monkeypatch.setattr(Processor, "__call__", lambda *a: runs.append(1) or call(*a))
    forward = family.cache()
    observed = forward.at(np.arange(5))
    for k in range(3):
        theta = family.scene.from_unit(jnp.full(5, 0.3 + 0.1 * k))
        forward(theta)
        jax.value_and_grad(lambda t: jnp.sum(observed(t) ** 2))(theta)
    assert len(runs) == 1


@pytest.mark.slow
def test_the_shipped_one_on_a_ventricle_it_has_not_seen(tmp_path: Path) -> None:
    """From a mesh file: no FEM run, and not far from FEM."""
    shape = {"wall": (21.0, 55.0, 31.0, 62.0, 17.0), "thicker": (0.1, 30.0)}
    unseen = em.scenes.left_ventricle(7, 22, 2, angles=(65.0, -55.0), **shape)
    write_mesh(tmp_path / "mine.vtu", unseen.mesh)
    path = tmp_path / "mine.toml"
    path.write_text(SCENE + "".join(PARAMETER.format(**p.to_json()) for p in unseen.parameters))
    scene = em.find_scene(str(path))
    emulator = load("ventricle_family", scene)
    u = em.Simulator(scene)(scene.centre)
    off = np.linalg.norm(emulator.cache()(scene.centre) - u, axis=-1)
    assert np.median(off) < 0.06 * np.median(np.linalg.norm(u, axis=-1))
