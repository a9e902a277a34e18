import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.surrogates.protocol import (
    ForwardKind,
    Ingredients,
    Option,
    fingerprint_of,
)
from emulator.surrogates.registry import (
    FORWARD_MAPS,
    build_forward,
    check_words,
    full_options,
    keep_forward,
    known_options,
    restore_forward,
)
from linear_support import linear_forward

OF_SPECIMENS = ("homogeneous", "incompressible")


def test_names_and_options():
    assert list(FORWARD_MAPS) == [
        "emulator",
        "corrected",
        "reduced",
        "rounds",
        "fem",
        *OF_SPECIMENS,
        "rows",
    ]
    assert full_options("corrected", {}) == {"steps": 1}
    assert full_options("reduced", {"fem_runs": 7}) == {"fem_runs": 7}
    assert full_options("fem", {}) == {}
    assert known_options()["fem_runs"][0].flag == "--fem-runs"


@pytest.mark.parametrize(
    ("name", "given", "message"),
    [
        (
            "spline",
            {},
            "forward map 'spline' is unknown; known: emulator, corrected, reduced, rounds",
        ),
        ("fem", {"fem_runs": 9}, "^--fem-runs has no effect without --forward reduced$"),
        ("reduced", {"order": 9}, "forward map 'reduced' has no option 'order'"),
        ("reduced", {"fem_runs": 2}, "fem_runs is 2; it must be 3 or more"),
        ("corrected", {"steps": "2"}, "steps is '2'; it must be a whole number"),
        ("corrected", {"steps": True}, "steps is True; it must be a whole number"),
        ("corrected", [2], "give a value by name"),
    ],
)
def test_options_that_cannot_be_used(name, given, message):
    with pytest.raises(InputError, match=message):
        full_options(name, given)


def test_an_option_of_two_kinds_names_both(monkeypatch):
    other = ForwardKind("other", "", lambda *_: None, (Option("steps", 2, ""),))
    monkeypatch.setitem(FORWARD_MAPS, "other", other)
    assert full_options("other", {}) == {"steps": 2}
    with pytest.raises(InputError, match="without --forward corrected or other"):
        full_options("fem", {"steps": 1})


def test_an_emulator_is_refused_where_none_is_used():
    check_words("emulator", emulator="mine")
    check_words("fem", emulator=None)
    with pytest.raises(InputError, match="--emulator has no effect without --forward emulator or"):
        check_words("fem", emulator="mine")


def test_every_kind_builds_a_map_with_its_name_and_its_own_fingerprint():
    scene = em.scenes.once_clamped_beam()
    simulator = em.Simulator(scene)
    made_of = Ingredients(scene, simulator)
    few = {"reduced": {"fem_runs": 3}}
    kinds = [name for name in FORWARD_MAPS if name not in (*OF_SPECIMENS, "rounds", "rows")]
    maps = {name: build_forward(name, made_of, few.get(name, {})) for name in kinds}
    for name, forward in maps.items():
        assert forward.kind == name
        assert forward.label
        np.testing.assert_array_equal(forward.nodes, np.arange(len(scene.mesh.nodes)))
    assert len({forward.fingerprint for forward in maps.values()}) == len(maps)
    assert maps["corrected"].label == "graph network + 1 Newton step"
    # Built again, a map is the same one; with other solver options FEM is another.
    for name in ("emulator", "corrected", "fem"):
        again = build_forward(name, Ingredients(scene, em.Simulator(scene)))
        assert again.fingerprint == maps[name].fingerprint
    loose = em.Simulator(scene, em.fem.NewtonOptions(tolerance=1e-6))
    assert build_forward("fem", Ingredients(scene, loose)).fingerprint != maps["fem"].fingerprint
    assert not maps["emulator"].evaluate(1.5 * scene.centre).valid


def test_only_a_fitted_map_is_kept(beam, simulator, tmp_path):
    path = tmp_path / "map.safetensors"
    for forward in (build_forward("fem", Ingredients(beam, simulator)), linear_forward(beam)):
        keep_forward(forward, path)
        assert not path.exists()
    assert restore_forward("fem", Ingredients(beam, simulator), {}, path).kind == "fem"


def test_fingerprints_of_arrays():
    x = np.arange(6.0)
    parts = [
        (x,),
        (x.reshape(2, 3),),
        (x.astype(np.float32),),
        (x[:3], x[3:]),
        ("a", "bc"),
        ("ab", "c"),
        ("abc",),
    ]
    assert len({fingerprint_of(*part) for part in parts}) == len(parts)
    assert fingerprint_of(jnp.asarray(x)) == fingerprint_of(x)
    assert fingerprint_of(x.reshape(2, 3).T) == fingerprint_of(x.reshape(2, 3).T.copy())
