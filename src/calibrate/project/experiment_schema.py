"""JSON Schema of experiment files, for editors that complete and check TOML.

Keys, types and descriptions are those of :class:`~calibrate.project.run.Run`, of the dataclasses
in the registries of noises, systematic errors and samplers, and of the options of forward maps.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Union

from pydantic import Field, create_model

from calibrate.noise import NOISES, DiscrepancyNoise
from calibrate.noise.spatial import KERNELS
from calibrate.priors.population import BOX, POPULATIONS, Population
from calibrate.project.experiment import MEMBERS, POPULATION, Cohort, Shared
from calibrate.project.run import Run
from calibrate.samplers import SAMPLERS
from calibrate.statistical_model.shared_errors import SHARED_ERRORS
from emulator.core.docstrings import documented
from emulator.core.schema import OneOf, Table, json_schema, table_of
from emulator.surrogates.registry import FORWARD_MAPS, known_options


def experiment_schema() -> dict[str, Any]:
    """Draft 2020-12. It admits what the reader admits, and knows neither the scene nor its data."""
    run: Any = _entries()
    about = documented(Cohort)
    of_cohort: dict[str, Any] = {
        MEMBERS: (dict[str, run], Field(None, description=about[MEMBERS])),
        POPULATION: (table_of(Shared), Field(None, description=about[POPULATION])),
    }
    schema = json_schema(create_model("ExperimentFile", __base__=run, **of_cohort))
    schema["description"] = "What was measured on which body, and what is not known of it."
    for table in schema["$defs"].values():
        if "kernel" in table["properties"]:
            table["properties"]["kernel"]["enum"] = list(KERNELS)
    # What the file does not say for all members, each has to say for itself.
    schema["$defs"][Run.__name__].pop("required")
    whole = [_said(key) for key in schema.pop("required")]
    whole.append({"dependentRequired": {POPULATION: [MEMBERS]}})
    return {"title": "Experiment file", **schema, "allOf": whole}


def _entries() -> type[Table]:
    """The table of a run, with a closer type for each entry that a run keeps as it was written."""
    noise = Annotated[Any, OneOf("kind", NOISES)]
    named, in_file = Literal[BOX, *POPULATIONS], Annotated[str, Field(pattern=r"\.json$")]
    discrepancy: Any = create_model("Discrepancy", __base__=table_of(DiscrepancyNoise))
    closer: dict[str, Any] = {
        "prior": Union[named, in_file, table_of(Population)],  # noqa: UP007
        "noise": Mapping[str, float | noise] | float,
        "discrepancy": dict[str, discrepancy],
        "systematic": dict[str, Annotated[Any, OneOf("kind", SHARED_ERRORS)]],
        "forward": Literal[tuple(FORWARD_MAPS)],
        "forward_options": _forward_options(),
        "sampler": Literal[tuple(SAMPLERS)],
        "sampler_options": Union[tuple(table_of(s.options) for s in SAMPLERS.values())],  # noqa: UP007
    }
    table = table_of(Run)
    entries: dict[str, Any] = {k: (hint, table.model_fields[k]) for k, hint in closer.items()}
    return create_model(Run.__name__, __base__=table, __doc__=table.__doc__, **entries)


def _forward_options() -> type[Table]:
    """Options of all forward maps: which of them is meant, a member may say for itself."""
    entries: dict[str, Any] = {}
    for name, (option, _) in known_options().items():
        shown: dict[str, Any] = {"default": option.default}
        entry = Field(None, ge=option.least, description=option.help, json_schema_extra=shown)
        entries[name] = (int, entry)
    return create_model("ForwardOptions", __base__=Table, **entries)


def _said(key: str) -> dict[str, Any]:
    """The entry is given, or each member gives it."""
    each = {MEMBERS: {"additionalProperties": {"required": [key]}}}
    return {"anyOf": [{"required": [key]}, {"required": [MEMBERS], "properties": each}]}
