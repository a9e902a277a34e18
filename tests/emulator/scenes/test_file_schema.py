"""The JSON Schema of scene files says what their reader says."""

import re
import tomllib
from pathlib import Path

import jsonschema
import pytest

from cli_support import SCENE, write_block
from emulator.core.errors import InputError
from emulator.core.schema import Source, expectation, parse, table_of
from emulator.mechanics.laws import LAWS
from emulator.scenes.draft import draft_scene
from emulator.scenes.fibre_rules import FIBRE_RULES
from emulator.scenes.file_schema import (
    BodyTable,
    ParameterTable,
    Plane,
    SceneFile,
    scene_schema,
)
from emulator.scenes.loads import LOADS
from emulator.scenes.supports import SUPPORTS

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="module")
def validator():
    schema = scene_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


def written():
    """Every scene file in the docs and in the tests."""
    found = [SCENE]
    for page in [*ROOT.glob("docs/*.md"), *ROOT.glob("tests/**/*.py")]:
        text = page.read_text(encoding="utf-8")
        found += re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
        found += re.findall(r'= """\n(law = .*?)"""', text, re.DOTALL)
    whole = re.compile(r"^law = .*^\[parameters", re.DOTALL | re.MULTILINE)
    complete = [text for text in found if whole.search(text) and "{" not in text]
    assert len(complete) > 3
    return dict.fromkeys(complete)


@pytest.mark.parametrize("text", written())
def test_what_the_reader_admits_the_schema_admits(validator, text):
    scene = tomllib.loads(text)
    parse(SceneFile, Source("scene.toml", scene))
    assert not [error.message for error in validator.iter_errors(scene)]


def test_what_init_drafts(validator, tmp_path):
    draft_scene(write_block(tmp_path).with_name("block.vtu"), tmp_path / "draft.toml")
    text = (tmp_path / "draft.toml").read_text(encoding="utf-8")
    assert not [error.message for error in validator.iter_errors(tomllib.loads(text))]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('law = "neo_hookean"\n', ""),
        ('law = "neo_hookean"', 'law = "neo_hookean"\nlaws = "neo_hookean"'),
        ('kind = "gravity"', 'kind = "gravty"'),
        ('kind = "gravity"', ""),
        ('kind = "gravity"', 'kind = "gravity"\npressure = 1.0'),
        ('kind = "gravity"', 'kind = "gravity"\ndirection = [0.0, 1.0]'),
        ('node_set = "left"', 'nodeset = "left"'),
        ("range = [5, 20]", "range = [5, 20, 30]"),
        ("range = [5, 20]", 'range = [5, 20]\nscale = "logarithmic"'),
        ("lam = 30.0", 'lam = "30.0"'),
        ('axis = "x"', 'axis = "w"'),
    ],
)
def test_what_both_refuse(validator, old, new):
    assert old in SCENE
    scene = tomllib.loads(SCENE.replace(old, new))
    with pytest.raises(InputError, match=r"scene\.toml"):
        parse(SceneFile, Source("scene.toml", scene))
    assert not validator.is_valid(scene)


@pytest.mark.parametrize(("old", "new"), [("neo_hookean", "neohookean"), ('"kPa"', '"MPa"')])
def test_laws_and_units_are_known(validator, old, new):
    """The reader refuses these when it makes the scene."""
    assert not validator.is_valid(tomllib.loads(SCENE.replace(old, new)))


def test_all_kinds_are_there_and_described():
    schema = scene_schema()
    assert schema["properties"]["law"]["enum"] == list(LAWS)
    for kind in [*LOADS.values(), *SUPPORTS.values(), *FIBRE_RULES.values()]:
        table = schema["$defs"][kind.__name__]
        bare = [name for name, key in table["properties"].items() if not key.get("description")]
        assert not bare, f"{kind.__name__}: no word on {bare}"
    assert "kPa/mm" in schema["$defs"]["ElasticSupport"]["properties"]["stiffness"]["description"]


def reference():
    """Lines of docs/scene_files.md: each kind with its summary, each key with its meaning."""
    kinds = {**LOADS, **SUPPORTS, **FIBRE_RULES}
    tables = [SceneFile, ParameterTable, Plane, BodyTable, *map(table_of, kinds.values())]
    lines = [
        line for name, kind in kinds.items() for line in (f"### `{name}`", table_of(kind).__doc__)
    ]
    for table in tables:
        for key, entry in table.model_fields.items():
            meaning = " ".join(entry.description.split())
            lines.append(f"| `{key}` | {expectation(entry.annotation) or ''} | {meaning} |")
    return lines


def test_the_reference_has_every_key_with_its_meaning():
    page = (ROOT / "docs" / "scene_files.md").read_text(encoding="utf-8").splitlines()
    assert not [line for line in reference() if line not in page]
