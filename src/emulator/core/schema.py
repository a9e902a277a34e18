"""Plain data from TOML and JSON files, read into dataclasses and pydantic models.

A mistake is one :class:`~emulator.core.errors.InputError` that names file, line and key, what was
found and what would be right. Numbers are finite, and neither strings nor booleans.
"""

from __future__ import annotations

import inspect
import json
import re
import tomllib
import types
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, dataclass, field, fields
from functools import cached_property
from pathlib import Path as FilePath
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
import pydantic
from pydantic import BaseModel, ValidationError
from pydantic_core import CoreSchema, ErrorDetails, PydanticCustomError, core_schema

from emulator.core.errors import InputError, closest, look_up
from emulator.core.line_index import Path, json_lines, line_of, toml_lines
from emulator.core.store import parse_text, read_json

# ``names : text``, with its further lines indented; under a heading of its section or without one.
_ENTRY = re.compile(r"^(\w[\w, ]*?) : (.*?)(?=^\S|^\s*$|\Z)", re.MULTILINE | re.DOTALL)


def summary(kind: type) -> str:
    """Return the first sentence of a docstring, on one line and without markup."""
    return _plain((kind.__doc__ or "").split("\n\n")[0])


def documented(kind: type) -> dict[str, str]:
    """Return the text of each parameter in the docstrings of a class and its bases, by name."""
    texts: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        for names, text in _ENTRY.findall(inspect.cleandoc(base.__doc__ or "")):
            texts |= dict.fromkeys(names.split(", "), _plain(text))
    return texts


def _plain(text: str) -> str:
    text = re.sub(r":\w+:`~?([^`]*)`", r"\1", " ".join(text.split()))
    return text.replace("``", "").strip()


_SCALARS = {float: "number", int: "whole number", str: "string"}
# Pydantic's codes of a wrong type, where no field of a table has an expectation.
_EXPECTED = {
    "float_type": "a number",
    "finite_number": "a number",
    "string_type": "a string",
    "int_type": "a whole number",
    "tuple_type": "a list",
}


class Table(BaseModel):
    """A table of a file: no other keys than its fields, no value of another type."""

    model_config = pydantic.ConfigDict(
        extra="forbid",
        strict=True,
        frozen=True,
        allow_inf_nan=False,
        use_attribute_docstrings=True,  # a text below a field describes it in the schema
    )

    @pydantic.model_validator(mode="before")
    @classmethod
    def _check_keys(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            raise _mistake("a table")
        for key in data:
            if key not in cls.model_fields:
                known = ", ".join(sorted(cls.model_fields))
                close = closest(key, cls.model_fields)
                raise _mistake(key=key, problem=f"unknown key '{key}'; known: {known}{close}")
        for key, info in cls.model_fields.items():
            if info.is_required() and key not in data:
                several = get_origin(info.annotation) is tuple
                expected = expectation(info.annotation) or ("tables" if several else "a table")
                raise _mistake(problem=f"key '{key}' is missing; expected {expected}")
        return data

    @pydantic.field_validator("*", mode="wrap")
    @classmethod
    def _check_value(
        cls,
        value: Any,
        handler: pydantic.ValidatorFunctionWrapHandler,
        info: pydantic.ValidationInfo,
    ) -> Any:
        annotation = cls.model_fields[str(info.field_name)].annotation
        if any(get_origin(kind) is tuple for kind in (annotation, *get_args(annotation))):
            value = _as_tuples(value)  # files have lists only
        try:
            return handler(value)
        except ValidationError:
            if (expected := expectation(annotation)) is None:
                raise
            raise _mistake(expected) from None


@dataclass(frozen=True, eq=False)
class OneOf:
    """Annotation of a table whose ``key`` names one of several dataclasses.

    key : e.g. ``kind``.
    choices : the dataclasses by the value of ``key``; their fields are the table's other keys.
    default : value of ``key`` in a table without it.
    """

    key: str
    choices: Mapping[str, type]
    default: str | None = None

    @cached_property
    def _tables(self) -> dict[str, type[Table]]:
        """Return a table of each choice, made once, so that a schema defines it once."""
        return {name: table_of(choice, self.key, name) for name, choice in self.choices.items()}

    def __get_pydantic_core_schema__(
        self, _: Any, handler: pydantic.GetCoreSchemaHandler
    ) -> CoreSchema:
        tables = handler.generate_schema(Union[tuple(self._tables.values())])  # noqa: UP007
        return core_schema.no_info_wrap_validator_function(self._read, tables)

    def _read(self, data: Any, _: Any) -> Any:
        """Return the dataclass that a table describes."""
        if not isinstance(data, dict):
            raise _mistake("a table")
        expected = " or ".join(map(json.dumps, self.choices))
        if self.key not in data and self.default is None:
            raise _mistake(problem=f"key '{self.key}' is missing; expected {expected}")
        tag = data.get(self.key, self.default)
        if not isinstance(tag, str) or tag not in self.choices:
            expected += closest(tag, self.choices)
            raise _mistake(problem=f"{self.key} = {_shown(tag)}; expected {expected}", key=self.key)
        return _built(self.choices[tag], self._tables[tag].model_validate(data), self.key)

    def __get_pydantic_json_schema__(
        self, core: CoreSchema, handler: pydantic.GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Return the schema of the tables, each of which but the default's needs its ``key``."""
        members = handler(core)["anyOf"]
        for name, member in zip(self.choices, members, strict=True):
            table = handler.resolve_ref_schema(member)
            table["properties"][self.key] = {"const": name, "description": table["description"]}
            if name != self.default:
                # A table that occurs in several places is visited several times.
                table["required"] = list(dict.fromkeys([self.key, *table.get("required", ())]))
        return {"oneOf": members}


@dataclass(frozen=True)
class Source:
    """Data of a file, with the line numbers by which messages point at it.

    name : how messages call the file.
    data : its content.
    lines : line of each path, as far as known.
    toml : whether paths are written as in TOML, ``[parameters.mu]: range``.
    """

    name: str
    data: Any
    lines: Mapping[Path, int] = field(default_factory=dict)
    toml: bool = True

    def error(self, problem: str, path: Path = (), table: Path = ()) -> InputError:
        """Return ``problem`` as an error with file, line of ``path`` and name of ``table``."""
        line = line_of(self.lines, path)
        where = self.name if line is None else f"{self.name}, line {line}"
        named = f"{self.written(table)}: " if table else ""
        return InputError(f"{where}: {named}{problem}")

    @contextmanager
    def at(self, *path: str | int, table: Path = ()) -> Iterator[None]:
        """Point errors raised inside the context at the entry ``path``."""
        try:
            yield
        except InputError as error:
            raise self.error(str(error), path, table) from error

    def written(self, path: Path) -> str:
        """Return the name of a table as the file's author writes it."""
        if not self.toml:
            steps = (f"[{k}]" if isinstance(k, int) else f".{k}" for k in path)
            return "".join(steps).removeprefix(".")
        if isinstance(path[-1], int):
            return f"[[{'.'.join(map(str, path[:-1]))}]] number {path[-1] + 1}"
        return f"[{'.'.join(map(str, path))}]"


def read_toml(path: FilePath, noun: str) -> Source:
    """Return the content of a TOML file, which messages call ``noun`` and its path.

    Raises :class:`InputError` where there is no such file, or its content is not valid TOML.
    """
    name = f"{noun} {path}"
    if not path.is_file():
        raise InputError(f"{name} does not exist")
    try:
        text = path.read_text(encoding="utf-8")
        return Source(name, parse_text(tomllib.loads, text), toml_lines(text))
    except ValueError as error:
        raise InputError(f"{name} is not valid TOML: {error}") from error


def parse[Model: BaseModel](model: type[Model], source: Source) -> Model:
    """Return plain data of a file as a model.

    Raises :class:`InputError` of the first mistake: file, line and key, what was found and what
    would be right.
    """
    try:
        return model.model_validate(source.data)
    except ValidationError as caught:
        raise _first_mistake(source, caught.errors(include_url=False)[0]) from None


def read_json_as[Kind](kind: type[Kind], path: str | FilePath) -> Kind:
    """Return the dataclass ``kind`` from a JSON file; errors as in :func:`parse`."""
    data = read_json(path)
    lines = json_lines(FilePath(path).read_text(encoding="utf-8"))
    return read_as(kind, data, str(path), lines)


def read_as[Kind](
    kind: type[Kind], data: Any, where: str, lines: Mapping[Path, int] = {}, *, toml: bool = False
) -> Kind:
    """Return the dataclass ``kind`` from plain data of ``where``; errors as in :func:`parse`."""
    source = Source(where, data, lines, toml)
    table = parse(table_of(kind), source)
    try:
        return _built(kind, table)
    except InputError as error:
        first_word = str(error).split(" ", 1)[0]  # the message often begins with the field
        raise source.error(str(error), (first_word,)) from error


def describe(value: Any) -> dict[str, Any]:
    """Return a dataclass as plain data, which :func:`restore` reads: its ``kind`` and its fields.

    Fields with ``compare=False`` are left out: the program sets them, not a file.
    """
    kind = {"kind": value.kind} if hasattr(value, "kind") else {}
    return kind | {f.name: getattr(value, f.name) for f in fields(value) if f.compare}


def restore[Kind](
    kinds: Mapping[str, type[Kind]], description: Mapping[str, Any], noun: str
) -> Kind:
    """Return the dataclass from the plain data of :func:`describe`.

    kinds : the registry, from ``kind`` to dataclass.
    description : plain data, of which ``kind`` names the class and all else are its fields.
    noun : the word for one entry of the registry, such as ``noise``; it begins messages.

    Raises :class:`InputError`: the kind is unknown, or a field is unknown, missing or of the wrong
    type.
    """
    kind = look_up(kinds, description.get("kind"), noun)
    options = {name: value for name, value in description.items() if name != "kind"}
    return read_as(kind, options, f"{noun} '{description['kind']}'")


def table_of(kind: type, key: str = "", tag: str = "") -> type[Table]:
    """Return the model with the fields of a dataclass, and ``key`` with the only value ``tag``.

    Fields with ``compare=False`` are left out: the program sets them, not a file.
    """
    hints = get_type_hints(kind)
    entries: dict[str, Any] = {key: (Literal[tag], tag)} if key else {}
    for entry in (f for f in fields(kind) if f.compare):
        required = entry.default is MISSING and entry.default_factory is MISSING
        # np.ndarray stands for a vector in a file. Defaults are left to the dataclass, and shown.
        hint = tuple[float, float, float] if hints[entry.name] is np.ndarray else hints[entry.name]
        shown = None if entry.default is MISSING else json.loads(json.dumps(entry.default))
        about = pydantic.Field(
            ... if required else None,
            description=documented(kind).get(entry.name),
            json_schema_extra=None if shown is None else {"default": shown},
        )
        entries[entry.name] = (hint, about)
    return pydantic.create_model(kind.__name__, __base__=Table, __doc__=summary(kind), **entries)


def json_schema(model: type[Table]) -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of a file, from which editors complete and check it.

    It admits all that :func:`parse` admits. ``parse`` is stricter where a schema cannot say it.
    """
    schema = model.model_json_schema()
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **_for_files(schema)}


def _for_files(node: Any) -> Any:
    """Return a schema without null, which no file has, and without titles made of keys."""
    if isinstance(node, list):
        return [_for_files(entry) for entry in node if entry != {"type": "null"}]
    if not isinstance(node, dict):
        return node
    empty = {"default": None, "title": node.get("title")}
    entries = {
        key: _for_files(value)
        for key, value in node.items()
        if not (key in empty and value == empty[key] and not isinstance(value, dict))
    }
    (only,) = entries["anyOf"] if len(entries.get("anyOf", ())) == 1 else (None,)
    return {**only, **{k: v for k, v in entries.items() if k != "anyOf"}} if only else entries


def expectation(annotation: Any) -> str | None:
    """Return an expected value of this type, in words; None for tables and lists of them."""
    origin, args = get_origin(annotation), get_args(annotation)
    if annotation in _SCALARS:
        return f"a {_SCALARS[annotation]}"
    if annotation is bool:
        return "true or false"
    if origin is Literal:
        return " or ".join(map(json.dumps, args))
    if origin in (Union, types.UnionType):
        words = [expectation(arg) for arg in args if arg is not type(None)]
        return " or ".join(word for word in words if word) if all(words) else None
    if origin is tuple and args[0] in _SCALARS:
        count = "" if args[-1] is Ellipsis else f"{len(args)} "
        return f"{count}{_SCALARS[args[0]]}s in brackets"
    return None


def _built(kind: type, table: Table, key: str = "") -> Any:
    """Return the dataclass of a table, whose ``key`` names the class."""
    return kind(**{name: getattr(table, name) for name in table.model_fields_set if name != key})


def _mistake(expected: str = "", *, problem: str = "", key: str = "") -> PydanticCustomError:
    return PydanticCustomError(
        "mistake", "{problem}", {"expected": expected, "problem": problem, "key": key}
    )


def _first_mistake(source: Source, error: ErrorDetails) -> InputError:
    """Return the line about one of pydantic's errors."""
    path: Path = ()
    value_found = source.data
    for step in error["loc"]:  # which also names the members of a union
        inside = isinstance(value_found, dict) and step in value_found
        if inside or (isinstance(value_found, list) and isinstance(step, int)):
            path, value_found = (*path, step), value_found[step]
    context: dict[str, Any] = error.get("ctx", {})
    if error["type"] == "value_error":  # the dataclass refused its values
        return source.error(str(context["error"]), path, path)
    if context.get("problem"):
        key = context["key"]
        return source.error(context["problem"], (*path, key) if key else path, path)
    expected = context.get("expected") or _EXPECTED.get(error["type"], "a table")
    if source.toml and expected == "a list":
        expected = f"tables [[{path[-1]}]]"
    value = _shown(value_found)
    if expected == "a table" and path:
        return source.error(f"{source.written(path)} is {value}; expected a table", path)
    table, key = path[:-1], path[-1] if path else "content"
    return source.error(f"{key} = {value}; expected {expected}", path, table)


def _as_tuples(value: Any) -> Any:
    return tuple(map(_as_tuples, value)) if isinstance(value, list) else value


def _shown(value: Any) -> str:
    text = json.dumps(value, default=str, ensure_ascii=False)
    return text if len(text) <= 60 else f"{text[:57]}..."
