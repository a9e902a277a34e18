"""Observations of displacement fields, the files of their data, and their units.

A kind of observation is a subclass of :class:`Observation`; the kinds are listed in
:data:`OBSERVATIONS`. :class:`Observations` holds several of one body by name.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np

from calibrate.measurements.collection import (
    PRESENT,
    Observations,
    leave_out_missing,
    observations,
)
from calibrate.measurements.displacements import (
    Landmarks,
    Length,
    NodalDisplacements,
    landmarks,
    length_between,
    nodal_displacements,
    nodes_called,
    spread_landmarks,
    spread_nodes,
)
from calibrate.measurements.klotz import Klotz, KlotzVolume
from calibrate.measurements.observation import Observation, Scalar
from calibrate.measurements.parameter import MeasuredParameter
from calibrate.measurements.points import DISPLACEMENT
from calibrate.measurements.reaction import Reaction
from calibrate.measurements.strain import PointStrain, SegmentStrain, segment_strains, strains
from calibrate.measurements.surface import (
    RigidMarkers,
    SurfacePoints,
    rigid_markers,
    spread_on_surface,
    surface_distances,
    surface_points,
)
from calibrate.measurements.volume import CavityVolume
from calibrate.measurements.words import from_json, kinds_of, parse, usage_of
from calibrate.state_names import in_state, split
from emulator.core.errors import InputError, look_up
from emulator.core.rooms import offered
from emulator.scenes.forward_problem import ForwardProblem
from emulator.scenes.scene import with_mesh

# Kinds are tried in this order on a file's columns: `node` comes before `x,y,z`.
OBSERVATIONS: dict[str, type[Observation]] = {
    kind.kind: kind
    for kind in (
        NodalDisplacements,
        Landmarks,
        PointStrain,
        SegmentStrain,
        SurfacePoints,
        RigidMarkers,
        CavityVolume,
        KlotzVolume,
        Length,
        Reaction,
        *offered("calibrate.measurements.stress", "Stress"),
        *offered("calibrate.measurements.stretch", "Stretch"),
        *offered("calibrate.measurements.tube", "TubePressure"),
        *offered("calibrate.measurements.tube", "TubeForce"),
        MeasuredParameter,
    )
}

__all__ = [
    "DISPLACEMENT",
    "OBSERVATIONS",
    "CavityVolume",
    "Klotz",
    "KlotzVolume",
    "Landmarks",
    "MeasuredParameter",
    "Observation",
    "Observations",
    "Reaction",
    "Scalar",
    "landmarks",
    "leave_out_missing",
    "length_between",
    "nodal_displacements",
    "observations",
    "observations_from_json",
    "parse_observation",
    "rigid_markers",
    "segment_strains",
    "spread_landmarks",
    "spread_nodes",
    "spread_on_surface",
    "strains",
    "surface_distances",
    "surface_points",
]


def parse_observation(
    scene: ForwardProblem, text: str, seed: int = 0, states: Sequence[str] = ("",)
) -> Observations:
    """Return the observations that words joined by ``+`` name, e.g. ``landmarks:24+volume``.

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


def _parse_word(scene: ForwardProblem, word: str, seed: int) -> tuple[str, Observation]:
    """Return name and observation; a word's part before the colon is its kind, else it is nodes."""
    kinds = kinds_of(scene)
    if kind := kinds.get(word.partition(":")[0]):
        return parse(kind, scene, word, seed)
    if scene.components:
        raise InputError(f"observe '{word}': of '{scene.name}' there are {', '.join(kinds)}")
    if nodes := nodes_called(with_mesh(scene), word):
        return DISPLACEMENT, nodes
    raise InputError(
        f"observe '{word}': give {'; '.join(map(usage_of, kinds.values()))}; "
        f"node sets: {', '.join(sorted(with_mesh(scene).mesh.node_sets)) or 'none here'}"
    )


def observations_from_json(
    scene: ForwardProblem, description: Mapping[str, Mapping[str, Any]]
) -> Observations:
    """Return the observations that :meth:`Observations.to_json` described."""
    kinds = kinds_of(scene)

    @cache
    def made(text: str) -> Observation:
        words = json.loads(text)
        return from_json(look_up(kinds, words.get("kind"), "observation kind"), scene, words)

    parts, entries = dict[str, Observation](), dict[str, np.ndarray]()
    for name, words in description.items():
        parts[name] = made(json.dumps({key: words[key] for key in words if key != PRESENT}))
        if PRESENT in words:
            entries[name] = np.asarray(words[PRESENT])
    return Observations(parts, entries)
