from dataclasses import fields, replace
from functools import partial

import numpy as np
import pytest

import emulator as em
from emulator.geometry.discretisation import quadrature_points
from emulator.geometry.mesh import Mesh
from emulator.mechanics.laws import LAWS
from emulator.mechanics.laws.law import Quantity, law_identity, probed
from emulator.scenes import Parameter, Support
from emulator.scenes.identity import _LEFT_OUT, _as_set, described
from emulator.scenes.loads import (
    LOADS,
    ActiveTension,
    FollowerPressure,
    Force,
    Gravity,
    GravityVector,
    Prestress,
    Traction,
)
from emulator.scenes.scene_data import SceneData
from emulator.scenes.supports import SUPPORTS, Dashpots, ElasticSupport
from emulator.scenes.tissue import FibreAngles
from emulator.specimens.grips import Grips, GripStresses
from emulator.specimens.specimen import Specimen, specimen
from emulator.specimens.states import states
from emulator.specimens.tube import Tube
from emulator.viscosity.series import Viscosity
from scene_support import block


def test_facet_sets_are_sets_of_facets_not_columns_of_nodes():
    one, other = np.array([[1, 2, 9], [3, 4, 5]]), np.array([[1, 2, 5], [3, 4, 9]])
    np.testing.assert_array_equal(np.sort(one, axis=0), np.sort(other, axis=0))
    assert not np.array_equal(_as_set(one), _as_set(other))
    np.testing.assert_array_equal(_as_set(one), _as_set(one[::-1][:, [2, 0, 1]]))


def test_a_load_on_other_facets_is_another_scene():
    scene = block(cells=(2, 2, 2))
    right = scene.mesh.facet_set("right")

    def loaded(facets):
        mesh = replace(scene.mesh, facet_sets={"loaded": facets})
        return replace(scene, mesh=mesh, loads=(Traction("loaded", (0.0, 0.0, 1.0)),))

    one, other = loaded(right[:4]), loaded(right[[0, 1, 2, 5]])
    assert one.fingerprint != other.fingerprint
    assert not one.identity.agrees(other.identity)
    again = loaded(right[[3, 1, 0, 2]][:, [2, 0, 1]])
    assert again.fingerprint == one.fingerprint
    assert again.identity.agrees(one.identity)


def test_an_edited_law_is_another_law(beam):
    law = beam.law
    doubled = replace(law, energy=lambda strain, mu, lam: law.energy(strain, 2.0 * mu, lam))
    assert doubled.name == law.name
    edited = replace(beam, law=doubled)
    assert edited.fingerprint != beam.fingerprint
    assert not edited.identity.agrees(beam.identity)
    same = replace(law, energy=lambda strain, mu, lam: law.energy(strain, mu, lam))
    assert replace(beam, law=same).fingerprint == beam.fingerprint


@pytest.mark.parametrize("name", sorted(LAWS))
def test_probes_see_every_parameter_and_stay_where_the_law_is_defined(name):
    law = LAWS[name]
    energies = probed(law)
    assert np.isfinite(energies).all()
    for k in range(len(law.parameters)):

        def less(strain, *values, k=k):
            return law.energy(strain, *values[:k], 0.99 * values[k], *values[k + 1 :])

        assert law_identity(replace(law, energy=less)) != law_identity(law)


def test_springs_regions_sheets_and_dilatation_count(ventricle):
    scene = replace(ventricle, supports=(Support("base"), ElasticSupport("epicardium", 0.2)))
    assert scene.fingerprint != ventricle.fingerprint
    stiffer = replace(scene, supports=(Support("base"), ElasticSupport("epicardium", 0.3)))
    assert not stiffer.identity.agrees(scene.identity)
    labels = np.arange(len(ventricle.mesh.elements)) % 2 + 1
    ones = {"stiffness_1": 1.0, "stiffness_2": 1.0}
    regions = replace(ventricle, regions=labels, constants={**ventricle.constants, **ones})
    swapped = replace(regions, regions=3 - labels)
    assert not regions.identity.agrees(swapped.identity)
    assert not regions.identity.agrees(ventricle.identity)
    assert regions.fingerprint != swapped.fingerprint


def test_listing_elements_in_another_order_changes_nothing(ventricle):
    order = np.random.default_rng(0).permutation(len(ventricle.mesh.elements))
    even = order[:, None] % 2 == 0
    elements = ventricle.mesh.elements[order]
    elements = np.where(even, elements[:, [1, 2, 0, 3]], elements)  # turned, as large as before
    listed = replace(
        ventricle, mesh=replace(ventricle.mesh, elements=elements), fibres=ventricle.fibres[order]
    )
    assert listed.fingerprint == ventricle.fingerprint
    assert listed.identity.agrees(ventricle.identity)
    mixed = replace(listed, fibres=ventricle.fibres)
    assert not mixed.identity.agrees(ventricle.identity)


def turned(mesh, which):
    """``mesh`` with the corners of some elements listed from the second on, and all points' places.

    The last are (m, 4) numbers of the quadrature points in the mesh given, found by where they are.
    """
    # Corners, then the midpoints of 01, 12, 02, 03, 13 and 23.
    round_once = [1, 2, 0, 3, 5, 6, 4, 8, 9, 7]
    elements = np.where(which[:, None], mesh.elements[:, round_once], mesh.elements)
    before, after = (
        np.einsum("qa,mai->mqi", quadrature_points(2), mesh.nodes[rows[:, :4]])
        for rows in (mesh.elements, elements)
    )
    apart = np.linalg.norm(after[:, :, None] - before[:, None], axis=-1)
    return Mesh(mesh.nodes, elements, mesh.node_sets, mesh.facet_sets), apart.argmin(axis=2)


def test_points_belong_to_their_corners_however_these_are_listed():
    scene = em.scenes.left_ventricle(3, 6, 1)
    count = len(scene.mesh.elements)
    assert scene.fibres.shape == (count, 4, 3)
    mesh, places = turned(scene.mesh, np.arange(count) % 2 == 0)
    assert (np.sort(places, axis=1) == np.arange(4)).all()
    assert (places != np.arange(4)).any(axis=1).sum() == count // 2
    moved = np.take_along_axis(scene.fibres, places[:, :, None], axis=1)
    order = np.random.default_rng(0).permutation(count)
    listed = replace(
        scene, mesh=replace(mesh, elements=mesh.elements[order]), fibres=moved[order], origin={}
    )
    assert listed.fingerprint == scene.fingerprint
    assert listed.identity.agrees(scene.identity)
    # Fibres left where they were now lie at other points; so do two that change places.
    stayed = replace(scene, mesh=mesh, origin={})
    swapped = np.array(scene.fibres)
    swapped[5, [0, 3]] = swapped[5, [3, 0]]
    for other in (stayed, replace(scene, fibres=swapped, origin={})):
        assert other.fingerprint != scene.fingerprint
        assert not other.identity.agrees(scene.identity)


def test_the_box_and_the_order_of_theta_are_in_the_fingerprint_only(beam):
    mu, lam = beam.parameters
    turned = replace(beam, parameters=(lam, mu))
    wider = replace(beam, parameters=(Parameter("mu", "kPa", 40.0, 100.0, "log"), lam))
    for other in (turned, wider):
        assert other.fingerprint != beam.fingerprint
        assert other.identity.agrees(beam.identity)
    heavier = replace(beam, loads=(Gravity(density=1.1, acceleration=9.80),))
    assert not heavier.identity.agrees(beam.identity)


def test_lengths_may_differ_by_what_single_precision_loses(beam):
    stored = beam.mesh.nodes.astype(np.float32).astype(float)
    assert replace(beam, mesh=replace(beam.mesh, nodes=stored)).identity.agrees(beam.identity)
    moved = beam.mesh.nodes + [0.0, 0.0, 0.01]
    assert not replace(beam, mesh=replace(beam.mesh, nodes=moved)).identity.agrees(beam.identity)


def test_the_released_models_are_told_from_ours(published):
    from emulator.released.scenes import published_scene

    ours = em.scenes.once_clamped_beam(order=1)
    assert ours.identity.agrees(published_scene("OnceClampedBeam", published).identity)
    assert not ours.identity.agrees(em.scenes.twice_clamped_beam(order=1).identity)


# One of every kind of load and support, and another value of each of its fields; a field that is
# not here fails the test.
PARTS = {
    "gravity": (Gravity(), {"density": 1.1, "direction": (0.0, 1.0, 0.0), "acceleration": 3.7}),
    "gravity_vector": (GravityVector(), {"density": 1.1, "parameter": "g"}),
    "force": (
        Force("top", (0.0, 0.0, 1e-3)),
        {"node_set": "left", "resultant": (0.1, 0, 0), "amount": "weight"},
    ),
    "traction": (Traction("top", (0.0, 0.1, 0.0)), {"facet_set": "left", "traction": (0.1, 0, 0)}),
    **{
        kind: (LOADS[kind]("top"), {"facet_set": "left", "pressure": 0.3, "parameter": "p"})
        for kind in LOADS
        if kind.endswith("_pressure")
    },
    "active_tension": (
        ActiveTension(),
        {"tension": 3.0, "parameter": "contractility", "transverse": 0.2, "within": "left"},
    ),
    "prestress": (Prestress(), {"tension": 3.0, "normal": "y", "parameter": "tight"}),
    "held": (
        Support("bottom", np.array([0.1, 0.0, 0.0]), amount="shear"),
        {
            "node_set": "right",
            "displacement": np.array([0.0, 0.0, 0.1]),
            "components": "xz",
            "amount": None,
        },
    ),
    "dashpots": (
        Dashpots("right"),
        {"facet_set": "left", "damping": 0.6, "direction": "normal", "parameter": "slow"},
    ),
    "elastic": (
        ElasticSupport("right"),
        {"facet_set": "left", "stiffness": 0.6, "direction": "normal", "parameter": "clamp"},
    ),
}


@pytest.mark.parametrize("kind", [*LOADS, *SUPPORTS])
def test_every_field_of_every_load_and_support_counts(kind):
    part, others = PARTS[kind]
    plain = block()
    if kind == "valve_pressure":  # a plane has no inside: all sides but the one that is named
        sides = plain.mesh.facet_sets
        sets = {n: np.concatenate([f for m, f in sides.items() if m != n]) for n in sides}
        plain = replace(plain, mesh=replace(plain.mesh, facet_sets=sets))

    def scene(part):
        names = {q.name: q for q in getattr(part, "quantities", ())}
        slow = {"inertia": {"density": 1.0}} if kind == "dashpots" else {}
        names |= {"time": Quantity("time", "s")} if slow else {}
        own = tuple(Parameter(n, q.unit, 0.1, 1.0) for n, q in names.items())
        base = replace(plain, loads=(), origin={})
        parameters = tuple(p for p in base.parameters if p.name in base.law.parameters)
        beside = (ElasticSupport("left", 1.0),) if kind == "held" else base.supports
        given = {"loads": (part,)} if kind in LOADS else {"supports": (*beside, part), **slow}
        held = (*base.supports, *(Support(s) for s in ("top", "left") if "cavity" in kind))
        given = given if kind in SUPPORTS else {**given, "supports": held}
        if getattr(part, "fibres", False):
            given["fibres"] = np.tile([1.0, 0.0, 0.0], (len(base.mesh.elements), 1))
        return replace(base, parameters=(*parameters, *own), **given).fingerprint

    assert set(others) == {each.name for each in fields(part)}
    told = {scene(part)} | {scene(replace(part, **{name: v})) for name, v in others.items()}
    assert len(told) == 1 + len(others)


LAW = LAWS["holzapfel_ogden_orthotropic"]
COUNT = len(block().mesh.elements)
DIRECTIONS = {axis: np.tile(np.eye(3)[k], (COUNT, 1)) for k, axis in enumerate("xyz")}
LEARNED = GripStresses(np.zeros((1, 2)), np.zeros((1, 3, 3, 3)), 0.01, "of")
GRIPS = Grips((10.0, 10.0, 1.0), marks=3.0, learned=LEARNED)
TUBE = Tube(0.4, (0.1,))
TURNED = FibreAngles(DIRECTIONS["z"], {"angle": np.ones(COUNT)})


def piece(**changes):
    """Return a scene in which every field can be changed alone."""
    entries = {
        "law": LAW,
        "parameters": (Parameter("a", "kPa", 1.0, 2.0), Parameter("pressure", "kPa", 1.0, 2.0)),
        "loads": (FollowerPressure("right"),),
        "fibres": DIRECTIONS["x"],
        "sheets": DIRECTIONS["y"],
        "regions": np.arange(COUNT) % 2,
        "stiffness_modes": np.linspace(-0.1, 0.1, COUNT)[:, None],
        "constants": {
            **{name: 1.0 for name in LAW.parameters if name != "a"},
            **{"stiffness_0": 1.0, "stiffness_1": 1.0, "stiffness_mode_1": 0.0},
        },
    } | changes
    for name, value in ("angle", entries.get("angles")), ("imaged", entries.get("loaded_by")):
        if value:
            entries["constants"] = entries["constants"] | {name: 0.5}
    if entries.get("viscosity"):
        entries["constants"] = entries["constants"] | {"relaxation_1": 0.5, "tau_1": 1.0}
    if entries.get("viscosity") or entries.get("inertia"):
        entries["parameters"] = (*entries["parameters"], Parameter("time", "s", 0.0, 1.0))
    return replace(block(), **entries)


STATES = states({"stretch_x": np.array([1.0, 1.1]), "shear_xy": np.array([0.0, 0.1])})
PULLED = states({"applied_x": np.array([0.0, 2.0]), "stretch_y": np.array([1.0, 1.1])})
TURNED_STATES = FibreAngles(np.tile([0.0, 0.0, 1.0], (2, 1)), {"angle": np.ones(2)})


def specimen_of(**changes):
    """Return a specimen in which every field can be changed alone."""
    entries = {
        "name": "piece",
        "states": STATES,
        "law": LAW,
        "parameters": (Parameter("a", "kPa", 1.0, 2.0),),
        "fibres": [1.0, 0.0, 0.0],
        "sheets": [0.0, 1.0, 0.0],
        "constants": {name: 1.0 for name in LAW.parameters if name != "a"},
    } | changes
    if entries.get("angles"):
        entries["constants"] = entries["constants"] | {"angle": 0.5}
    if len(getattr(entries.get("tube"), "layers", ())) > 1:
        entries["constants"] = entries["constants"] | {"stiffness_1": 1.0}
    return Specimen(**entries)


# Another value of every field of a scene; a field that is neither here nor an exception fails.
MESH = block().mesh
FIELDS = {
    "mesh": replace(MESH, nodes=1.1 * MESH.nodes),
    "law": replace(LAW, energy=lambda strain, *theta: 2.0 * LAW.energy(strain, *theta)),
    "parameters": (Parameter("a", "kPa", 1.0, 3.0), Parameter("pressure", "kPa", 1.0, 2.0)),
    "loads": (FollowerPressure("top"),),
    "supports": (Support("bottom"),),
    "constants": piece().constants | {"b": 2.0},
    "fibres": DIRECTIONS["z"],
    "sheets": DIRECTIONS["z"],
    "regions": (np.arange(COUNT) + 1) % 2,
    "stiffness_modes": np.linspace(0.1, 0.2, COUNT)[:, None],
    "angles": (TURNED,),
    "dilatation": "patch",
    "loaded_by": {"pressure": "imaged"},
    "viscosity": {"kind": "prony"},
    "inertia": {"density": 1.1},
}
FIELDS_OF_SPECIMENS = {
    "states": states({"stretch_x": np.array([1.0, 1.1]), "shear_xy": np.array([0.0, 0.2])}),
    "law": FIELDS["law"],
    "parameters": (Parameter("a", "kPa", 1.0, 3.0),),
    "constants": specimen_of().constants | {"b": 2.0},
    "fibres": [0.0, 0.0, 1.0],
    "sheets": [0.0, 0.0, 1.0],
    "angles": (TURNED_STATES,),
    "tube": TUBE,
    "grips": GRIPS,
}
# The same of what a field consists of.
PARTS_OF_FIELDS = {
    "states": (
        PULLED,
        {
            "gradients": 1.1 * PULLED.gradients,
            "free": ~PULLED.free,
            "pulls": 1.1 * PULLED.pulls,
            "protocols": {"creep": np.arange(2)},
        },
    ),
    "tube": (
        TUBE,
        {"inner_radius": 0.8, "layers": (0.05, 0.05), "opening_angle": 20.0, "points": 6},
    ),
    "grips": (
        GRIPS,
        {
            "size": (10.0, 10.0, 2.0),
            "held": "hooks",
            "hooks": 4,
            "cells": 6,
            "marks": None,
            "learned": None,
        },
    ),
    "learned": (
        LEARNED,
        {
            "degrees": np.ones((1, 2)),
            "shares": np.ones((1, 3, 3, 3)),
            "error": 0.02,
            "of": "another",
        },
    ),
    "angles": (
        TURNED,
        {"axis": DIRECTIONS["x"], "shares": {"angle": np.linspace(0.0, 1.0, COUNT)}},
    ),
}


def test_every_field_of_a_scene_counts():
    assert set(FIELDS) | _LEFT_OUT - {"homogeneous", "table"} == {
        each.name for each in fields(SceneData)
    }
    scenes = [piece(), *(piece(**{name: value}) for name, value in FIELDS.items())]
    assert len({scene.fingerprint for scene in scenes}) == len(scenes)
    assert not any(scenes[0].identity.agrees(scene.identity) for scene in scenes[1:] if
                   scene.parameters == scenes[0].parameters)  # fmt: skip


def test_every_field_of_a_specimen_counts():
    through_time = {"viscosity", "times"}  # below
    assert set(FIELDS_OF_SPECIMENS) | _LEFT_OUT | through_time == {
        each.name for each in fields(Specimen)
    }
    pieces = [specimen_of()]
    pieces += [specimen_of(**{name: value}) for name, value in FIELDS_OF_SPECIMENS.items()]
    assert len({piece.fingerprint for piece in pieces}) == len(pieces)
    assert specimen_of(homogeneous=True, name="other").fingerprint == pieces[0].fingerprint


def test_viscosity_and_times_of_a_specimen_count():
    """Times are left out without viscosity; its kind and terms are all that it has."""
    assert {each.name for each in fields(Viscosity)} == {"kind", "terms"}
    times = np.arange(float(len(STATES.free)))

    def viscous(viscosity, times=times):
        constants = {quantity.name: 0.5 for quantity in viscosity.quantities}
        constants |= specimen_of().constants
        return specimen_of(constants=constants, viscosity=viscosity, times=times)

    kinds = Viscosity(), Viscosity(terms=2), Viscosity("spectrum"), Viscosity("spectrum", 8)
    pieces = [specimen_of(), *map(viscous, kinds), viscous(kinds[0], 2.0 * times)]
    assert len({piece.fingerprint for piece in pieces}) == len(pieces)
    assert specimen_of(times=times).fingerprint == pieces[0].fingerprint


@pytest.mark.parametrize("name", PARTS_OF_FIELDS)
def test_every_part_of_a_field_counts(name):
    part, others = PARTS_OF_FIELDS[name]
    names = part._fields if name == "states" else [each.name for each in fields(part)]
    assert set(others) == set(names)
    changed = part._replace if name == "states" else partial(replace, part)

    def scene(value):
        if name == "angles":
            return piece(angles=(value,))
        if name == "learned":
            return specimen_of(grips=replace(GRIPS, learned=value))
        return specimen_of(**{name: value})

    told = {scene(part).fingerprint}
    told |= {scene(changed(**{field: v})).fingerprint for field, v in others.items()}
    assert len(told) == 1 + len(others)


def test_scenes_keep_the_fingerprint_that_saved_files_carry():
    assert em.scenes.once_clamped_beam(order=1).fingerprint == "a963beb3023c18b0"
    assert em.scenes.once_clamped_beam().fingerprint == "7ea647097ea5c9ad"
    strip = specimen(
        {"stretch_x": np.array([1.0, 1.05, 1.1])},
        law=LAWS["neo_hookean"],
        parameters=(Parameter("mu", "kPa", 5.0, 20.0), Parameter("lam", "kPa", 1.0, 100.0)),
    )
    assert strip.fingerprint == "ed09f1b5398a0703"


def test_an_identity_refuses_what_it_cannot_describe():
    with pytest.raises(TypeError, match="cannot describe a object"):
        described(object())
    assert described(np.array([0.0, np.nan])) != described(np.array([np.nan, 0.0]))
    assert described((1, -0.0)) == described([1.0, 0.0])
