import json
import re

import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.fem import sobol
from emulator.surrogates import load, save_emulator, shipped
from network_support import untrained


@pytest.fixture(scope="module")
def emulator(beam):
    return untrained(beam)


@pytest.fixture
def folder(emulator, tmp_path):
    save_emulator(emulator, tmp_path / "e")
    return tmp_path / "e"


def test_a_saved_emulator_is_the_same(emulator, folder, beam):
    back = load(folder)
    assert back.fingerprint == emulator.fingerprint
    assert back.scene.fingerprint == beam.fingerprint
    np.testing.assert_array_equal(back(beam.centre), emulator(beam.centre))
    assert sorted(path.name for path in folder.iterdir()) == [
        "emulator.json",
        "weights.safetensors",
    ]


def test_a_truncated_weights_file(folder):
    path = folder / "weights.safetensors"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match=r"weights.safetensors is truncated or not a safetensors"):
        load(folder)


def test_weights_of_another_emulator(folder, emulator, beam, tmp_path):
    save_emulator(untrained(beam, seed=1), tmp_path / "other")
    (tmp_path / "other" / "weights.safetensors").replace(folder / "weights.safetensors")
    with pytest.raises(InputError, match="is not the file emulator.json was written with"):
        load(folder)


def test_a_scene_that_does_not_match(folder):
    with pytest.raises(InputError, match="was trained for a scene with fingerprint"):
        load(folder, em.scenes.twisting_cube(cells=2, order=1))


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda d: d.pop("parts"), "emulator.json lacks or garbles 'parts'"),
        (lambda d: d["parts"]["network"].clear(), "'network' lacks or garbles 'architecture'"),
        (
            lambda d: d["parts"].update(discrepancy={}),
            "'discrepancy' lacks or garbles 'centre'",
        ),
        (
            lambda d: d["parts"].update(magic={}),
            "part 'magic' is unknown; known: coarse, taylor, polynomial, network",
        ),
        (lambda d: d.update(format=2), "has format 2; this version reads 3: train .* again"),
        (lambda d: d["scene"].update(scene="heart"), "origin names scene 'heart'"),
        (lambda d: d["parts"]["network"]["architecture"].update(latent=9), "has shape .* expected"),
    ],
)
def test_damaged_descriptions(folder, edit, message):
    path = folder / "emulator.json"
    description = json.loads(path.read_text())
    edit(description)
    path.write_text(json.dumps(description))
    with pytest.raises(InputError, match=message):
        load(folder)


def test_missing_ones_are_named(tmp_path):
    with pytest.raises(
        InputError, match="neither shipped nor a folder with emulator.json; shipped: left_v"
    ):
        load("no_such_emulator")
    (tmp_path / "emulator.json").write_text("{")
    with pytest.raises(InputError, match="is not valid JSON"):
        load(tmp_path)


FAMILY = "ventricle_family"
# Networks shipped beside those, and what their median err_u in mm stays below: a tenth of what the
# paper's networks leave on such scenes, which is 2e-2, 8.5e-4, 8.8e-3 and 2.8e-2 mm.
ALONE = {
    "once_clamped_beam": 2e-3,
    "twisting_cube": 8.5e-5,
    "liver": 8.8e-4,
    "left_ventricle": 2.8e-3,
}
# Polynomials that no FEM run taught, and what their median err_u in mm stays below.
PHYSICS = {
    "once_clamped_beam_physics": 1e-8,
    "twisting_cube_physics": 1e-9,
    "liver_physics": 1e-8,
    "left_ventricle_physics": 1e-3,
}
SMALL_SCENES = ("once_clamped_beam",)
OF_A_PART = re.compile("_(series|physics)$")


@pytest.mark.parametrize("name", shipped())
def test_shipped_emulators_say_how_they_were_made(name):
    record = load(name).record
    assert record["seconds"] > 0
    assert record["hardware"]["cores"]
    if name == FAMILY:
        assert record["command"].startswith("python -m studies.any_ventricle --train")
        return
    recipe = (
        " --recipe physics " if name in ALONE else " --recipe sweeps " if name in PHYSICS else " "
    )
    assert record["command"].startswith(f"calibrate train {OF_A_PART.sub('', name)}{recipe}")


@pytest.mark.parametrize("name", sorted(set(shipped()) - {FAMILY, *ALONE, *PHYSICS}))
def test_shipped_emulators_hold_no_network(name):
    """Held-out runs chose the discrepancy model over the Taylor series alone."""
    found = load(name)
    assert list(found.parts) == ["taylor", "discrepancy"]
    chosen = found.record["discrepancy"]
    errors = chosen["held_out_err_u_mm"]
    assert chosen["on"] == "taylor" == min(errors, key=errors.get)


@pytest.mark.parametrize(
    ("name", "largest"),
    [
        pytest.param(*each, marks=() if each[0].startswith(SMALL_SCENES) else pytest.mark.slow)
        for each in (ALONE | PHYSICS).items()
    ],
)
def test_shipped_networks_and_polynomials_stand_alone(name, largest):
    """The centre's solution and the network, or the polynomial: nothing else; against FEM."""
    found = load(name)
    if name in ALONE:
        assert list(found.parts) == ["taylor", "network"]
        assert len(found.taylor.indices) == 0
    else:
        assert list(found.parts) == ["polynomial"]
    simulator, cached = em.Simulator(found.scene), found.cache()
    thetas = sobol(found.scene, 6, 11)
    errors = [np.linalg.norm(cached(theta) - simulator(theta), axis=-1) for theta in thetas]
    assert np.median(errors) < largest
