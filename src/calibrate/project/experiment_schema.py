"""JSON Schema of experiment files, for editors that complete and check TOML.

Keys, types and descriptions are those of :class:`~calibrate.project.run.Run`, of the dataclasses
in the registries of noises, systematic errors and samplers, and of the options of forward maps.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Union

from pydantic import Field, create_model

from calibrate.model_error.kinds import SYSTEMATIC_ERRORS
from calibrate.noise import NOISES, DiscrepancyNoise
from calibrate.priors.population import BOX, POPULATIONS, Population
from calibrate.project.members import POPULATION, Members, Shared
from calibrate.project.results import MEMBERS
from calibrate.project.run import Run
from calibrate.samplers import SAMPLERS
from emulator.core.docstrings import documented
from emulator.core.gaussian_process import CORRELATIONS
from emulator.core.schema import OneOf, Table, json_schema, table_of
from emulator.surrogates.registry import FORWARD_MAPS, known_options


def experiment_schema() -> dict[str, Any]:
    """Return the schema (draft 2020-12). It admits what the reader admits of any scene and data."""
    run: Any = _entries()
    about = documented(Members)
    tables: dict[str, Any] = {
        MEMBERS: (dict[str, run], Field(None, description=about[MEMBERS])),
        POPULATION: (table_of(Shared), Field(None, description=about[POPULATION])),
    }
    schema = json_schema(create_model("ExperimentFile", __base__=run, **tables))
    schema["description"] = "What was measured on which body, and what is not known of it."
    for table in schema["$defs"].values():
        if "kernel" in table["properties"]:
            table["properties"]["kernel"]["enum"] = list(CORRELATIONS)
    # An entry that the file lacks for all members is required of each member.
    schema["$defs"][Run.__name__].pop("required")
    whole = [_required(key) for key in schema.pop("required")]
    whole.append({"dependentRequired": {POPULATION: [MEMBERS]}})
    return {"title": "Experiment file", **schema, "allOf": whole}


def _entries() -> type[Table]:
    """Return the table of a run, with an exact type for entries that a run holds as plain data."""
    noise = Annotated[Any, OneOf("kind", NOISES)]
    named, in_file = Literal[BOX, *POPULATIONS], Annotated[str, Field(pattern=r"\.json$")]
    discrepancy: Any = create_model("Discrepancy", __base__=table_of(DiscrepancyNoise))
    exact: dict[str, Any] = {
        "prior": Union[named, in_file, table_of(Population)],  # noqa: UP007
        "noise": Mapping[str, float | noise] | float,
        "discrepancy": dict[str, discrepancy],
        "systematic": dict[str, Annotated[Any, OneOf("kind", SYSTEMATIC_ERRORS)]],
        "forward": Literal[tuple(FORWARD_MAPS)],
        "forward_options": _forward_options(),
        "sampler": Literal[tuple(SAMPLERS)],
        "sampler_options": Union[tuple(table_of(s.options) for s in SAMPLERS.values())],  # noqa: UP007
    }
    table = table_of(Run)
    entries: dict[str, Any] = {k: (hint, table.model_fields[k]) for k, hint in exact.items()}
    return create_model(Run.__name__, __base__=table, __doc__=table.__doc__, **entries)


def _forward_options() -> type[Table]:
    """Return the options of all forward maps: each member may choose its own map."""
    entries: dict[str, Any] = {}
    for name, (option, _) in known_options().items():
        shown: dict[str, Any] = {"default": option.default}
        entry = Field(None, ge=option.least, description=option.help, json_schema_extra=shown)
        entries[name] = (int, entry)
    return create_model("ForwardOptions", __base__=Table, **entries)


def _required(key: str) -> dict[str, Any]:
    """Return the schema of a file with the entry at the top, or in each member's table."""
    each = {MEMBERS: {"additionalProperties": {"required": [key]}}}
    return {"anyOf": [{"required": [key]}, {"required": [MEMBERS], "properties": each}]}
