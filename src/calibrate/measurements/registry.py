"""The kinds of observations there are: the one list of them, and how words and JSON find theirs."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calibrate.measurements.collection import Observations
from calibrate.measurements.displacements import Landmarks, Length, NodalDisplacements
from calibrate.measurements.klotz import KlotzVolume
from calibrate.measurements.observation import ENTRIES, Observation
from calibrate.measurements.parameter import MeasuredParameter
from calibrate.measurements.reaction import Reaction
from calibrate.measurements.strain import SegmentStrain, Strain
from calibrate.measurements.surface import RigidMarkers, SurfacePoints
from calibrate.measurements.volume import CavityVolume
from calibrate.state_names import in_state, split
from emulator.core.errors import InputError, look_up
from emulator.scenes.scene import Scene

# Kinds are tried in this order on a file's columns: `node` comes before `x,y,z`.
OBSERVATIONS: dict[str, type[Observation]] = {
    kind.kind: kind
    for kind in (
        NodalDisplacements,
        Landmarks,
        Strain,
        SegmentStrain,
        SurfacePoints,
        RigidMarkers,
        CavityVolume,
        KlotzVolume,
        Length,
        Reaction,
        MeasuredParameter,
    )
}


def parse_observation(
    scene: Scene, text: str, seed: int = 0, states: Sequence[str] = ("",)
) -> Observations:
    """Return what the words joined by ``+`` ask for, e.g. ``landmarks:24+volume``.

    A word is asked for in each of ``states``; ``volume@diastole`` in that load state only.

    Raises
    ------
    InputError
        A word that no kind understands, or two observations of the same name.
    """
    parts: dict[str, Observation] = {}
    for word in text.split("+"):
        bare, own_state = split(word)
        base, part = _parse_word(scene, bare, seed)
        for state in (own_state,) if own_state else states:
            if (name := in_state(base, state)) in parts:
                raise InputError(f"observe '{text}': {name} is given twice; once is enough")
            parts[name] = part
    return Observations(parts)


def _parse_word(scene: Scene, word: str, seed: int) -> tuple[str, Observation]:
    """Return name and observation; a word's part before the colon is its kind, others are tried."""
    named = OBSERVATIONS.get(word.partition(":")[0])
    for kind in (named,) if named else OBSERVATIONS.values():
        if (observation := kind.parse(scene, word, seed)) is not None:
            return observation
    raise InputError(
        f"observe '{word}': give {', '.join(kind.usage for kind in OBSERVATIONS.values())}; "
        f"node sets: {', '.join(sorted(scene.mesh.node_sets)) or 'none here'}"
    )


def observation_from_json(scene: Scene, description: Mapping[str, Any]) -> Observation:
    """Return the observation that :meth:`Observation.to_json` described."""
    kind = look_up(OBSERVATIONS, description.get("kind"), "observation kind")
    whole = kind.from_json(scene, description)
    return whole.restricted(np.asarray(description[ENTRIES])) if ENTRIES in description else whole


def observations_from_json(
    scene: Scene, description: Mapping[str, Mapping[str, Any]]
) -> Observations:
    """Return what :meth:`Observations.to_json` described; equal descriptions are one object."""
    texts = {name: json.dumps(part) for name, part in description.items()}
    distinct = {text: observation_from_json(scene, json.loads(text)) for text in texts.values()}
    return Observations({name: distinct[text] for name, text in texts.items()})
