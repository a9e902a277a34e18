"""Cards of shipped emulators say what their files have, and no more."""

import hashlib
import json

import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.scenes import BUILT_IN
from emulator.surrogates.card import model_card
from emulator.surrogates.folders import SHIPPED, shipped


@pytest.mark.parametrize("name", shipped())
def test_a_card_has_the_digest_of_the_weights_and_a_command(name):
    card = model_card(name)
    weights = (SHIPPED / name / "weights.safetensors").read_bytes()
    assert card.weights_sha256 == hashlib.sha256(weights).hexdigest()
    assert card.scene in BUILT_IN
    assert card.licence == "MIT"
    assert card.command
    assert all(p["low"] < p["high"] for p in card.theta)
    json.dumps(card._asdict(), allow_nan=False)


def test_the_range_of_theta_is_that_of_the_emulator():
    names = [p["name"] for p in model_card("once_clamped_beam").theta]
    assert names == list(em.load("once_clamped_beam").scene.parameter_names)
    a, *_, pressure = model_card("ventricle_family").theta  # a family has its own ranges
    assert (a["low"], a["high"], pressure["high"]) == (0.16, 0.65, 1.466542)


def test_errors_are_those_of_the_emulator_itself():
    (held_out,) = model_card("liver_series").errors
    assert held_out["value"] == 1.784340976652898e-08  # on the Taylor series, not on nothing
    assert held_out["statistic"] == "geometric mean"
    usual, most = model_card("liver_physics").errors
    assert (usual["value"], most["value"]) == (5.978866547388983e-10, 3.5932933290838895e-09)
    # Of the polynomial that the network learned from, the error is no error of the network.
    assert model_card("liver").errors == []


def test_fem_runs_are_those_that_were_made():
    names = ("liver", "liver_physics", "liver_series", "ventricle_family")
    assert [model_card(name).fem_runs for name in names] == [0, 0, 201, 3156]


def test_what_a_later_training_records_is_on_the_card(tmp_path, monkeypatch):
    """Errors of strains and volumes at held-out runs, and of a network by Newton's step."""
    file = tmp_path / "liver" / "emulator.json"
    file.parent.mkdir()
    (file.parent / "weights.safetensors").touch()
    description = json.loads((SHIPPED / "liver" / "emulator.json").read_text())
    held_out = {"err_V": {"median": 0.1, "max": 0.5}}
    description["record"] |= {
        "discrepancy": {"on": "taylor", "held_out_err_u_mm": {"taylor": 0.2}, "held_out": held_out},
        "equilibrium": {"error_mm": {"median": 0.3, "max": 0.4}},
    }
    file.write_text(json.dumps(description))
    for module in ("folders", "card"):
        monkeypatch.setattr(f"emulator.surrogates.{module}.SHIPPED", tmp_path)
    values = [entry["value"] for entry in model_card("liver").errors]
    assert values == [0.2, 0.1, 0.5, 0.3, 0.4]


def test_a_folder_of_a_user_has_no_card():
    with pytest.raises(InputError, match="emulator 'mine' is neither shipped nor"):
        model_card("mine")
