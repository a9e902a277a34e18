"""FEniCSx on the bodies of this study, beside ours (``studies/common/fenicsx.py``)."""

from collections.abc import Iterator

import jax.numpy as jnp
from studies.accuracy_vs_time.measure import References, errors
from studies.accuracy_vs_time.rungs import CLOCK, Place
from studies.common.fenicsx import compare
from studies.common.output import Case

import calibrate as cal

STAGE = "FEniCSx"


def examine(place: Place, known: References, python: str) -> Iterator[Case]:
    """Four rungs: ours and FEniCSx's, from rest and from a neighbour."""
    observed = cal.landmarks(place.scene, place.at).nodes
    names = (
        "FEM from rest, beside FEniCSx", "FEM from a neighbour", "FEniCSx from rest",
        "FEniCSx from a neighbour",
    )  # fmt: skip
    found = compare(place.scene, observed, jnp.asarray(known.tests), python, CLOCK)
    for name, case in zip(names, found, strict=True):
        fields = list(case.pop("displacement"))
        case = {k: v for k, v in case.items() if k not in ("gradient", "seconds", "both_s")}
        off = errors(place.scene, place, known, fields, full=True, own=True)
        kind = "FEniCSx" if "FEniCSx" in name.split(",")[0] else "FEM"
        yield {
            "rung": name, "kind": kind, "nodes": len(place.scene.mesh.nodes), **off,
            "offline_s": 0.0, "fem_runs": 0, **case,
        }  # fmt: skip
