"""What ARCHITECTURE.md says of adding things: one file each, and nobody else knows their kinds."""

import ast
import re
import subprocess
import sys
from functools import cache
from importlib import import_module
from pathlib import Path

import pytest

from calibrate.cli import COMMANDS, build_parser
from calibrate.measurements import OBSERVATIONS
from calibrate.noise import NOISES
from calibrate.samplers import SAMPLERS
from emulator.fem.formulations import FORMULATIONS
from emulator.mechanics.laws import LAWS
from emulator.neighbours.cards import PROGRAMS
from emulator.scenes.loads import LOADS
from emulator.scenes.supports import SUPPORTS
from emulator.surrogates.registry import FORWARD_MAPS
from rooms import room_of

ROOT = Path(__file__).resolve().parents[1]
REGISTRIES = {
    "a load": LOADS,
    "a support": SUPPORTS,
    "a forward map": FORWARD_MAPS,
    "an observation": OBSERVATIONS,
    "a noise": NOISES,
    "a sampler": SAMPLERS,
    "a formulation": FORMULATIONS,
    "a program to export to": PROGRAMS,
}


def rows():
    """What each thing touches, from the table: its paths, in order."""
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    table = text[text.index("| to add |") :].split("\n\n")[0]
    cells = [line.strip("|").split("|") for line in table.splitlines()[2:]]
    return {thing.strip(): re.findall(r"`([^`]+)`", touched) for thing, touched in cells}


@cache
def nodes():
    """Every node of the source, with its file."""
    files = {path: path.read_text(encoding="utf-8") for path in ROOT.glob("src/**/*.py")}
    return [(path, node) for path, text in files.items() for node in ast.walk(ast.parse(text))]


@cache
def words_of_comparisons_and_lists():
    """Constants inside each comparison and inside each tuple, list or set, with file and line."""
    return [
        (path, node.lineno, {n.value for n in ast.walk(node) if isinstance(n, ast.Constant)},
         1 if isinstance(node, ast.Compare) else 2)
        for path, node in nodes()
        if isinstance(node, ast.Compare | ast.Tuple | ast.List | ast.Set)
    ]  # fmt: skip


def test_the_page_is_read_in_one_sitting():
    lines = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 200
    cells = [cell for line in lines if line.startswith("|") for cell in line.split("|")]
    assert max(map(len, cells)) <= 200


def test_every_path_of_the_table_exists():
    for paths in rows().values():
        for path in paths:
            assert (ROOT / path.replace("<name>.py", "").replace("<name>/", "")).exists(), path


@pytest.mark.parametrize("thing", REGISTRIES)
def test_each_kind_has_a_file_where_the_table_says_and_a_line_in_its_registry(thing):
    pattern, registry = rows()[thing][:2]
    folder = ROOT / pattern.removesuffix("<name>.py")
    line = ast.parse((ROOT / registry).read_text(encoding="utf-8"))
    imported = {
        _dotted(folder / f"{node.module.rsplit('.', 1)[1]}.py"): {name.name for name in node.names}
        for node in ast.walk(line)
        if isinstance(node, ast.ImportFrom) and node.module and "." in node.module
    }
    modules = [(m, words) for m, words in imported.items() if _file(m).is_file()]
    for node in ast.walk(line):  # what a room offers is in a file of the room
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "offered":
            module, word = (argument.value for argument in node.args)
            assert room_of(module) is not None
            modules.append((module, {word}))
    for name, kind in REGISTRIES[thing].items():
        homes = [
            module
            for module, words in modules
            if any(getattr(import_module(module), word, None) is kind for word in words)
        ]
        assert len(homes) == 1, f"{name} is not imported by its registry from a file in {folder}"


def _file(module):
    return ROOT / "src" / f"{module.replace('.', '/')}.py"


def _dotted(path):
    return ".".join(path.relative_to(ROOT / "src").with_suffix("").parts)


def _class_names(registry):
    return {kind.__name__ for kind in registry.values() if isinstance(kind, type)}


def test_nobody_asks_what_kind_a_thing_is():
    classes = set().union(*map(_class_names, REGISTRIES.values()))
    found = [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for path, node in nodes()
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id == "isinstance"
        and classes & {name.id for name in ast.walk(node.args[1]) if isinstance(name, ast.Name)}
    ]
    assert not found


@pytest.mark.parametrize("thing", REGISTRIES)
def test_nobody_compares_or_lists_names_of_kinds(thing):
    names, folder = set(REGISTRIES[thing]), rows()[thing][0].removesuffix("<name>.py")
    found = [
        f"{path.relative_to(ROOT)}:{line} {sorted(words & names)}"
        for path, line, words, most in words_of_comparisons_and_lists()
        if len(words & names) >= most and not str(path.relative_to(ROOT)).startswith(folder)
    ]
    assert not found


def test_laws_and_commands_are_found_in_their_folders():
    laws = ROOT / rows()["a law"][0].removesuffix("<name>.py")
    assert {path.stem for path in laws.glob("*.py")} > {"neo_hookean", "guccione"}
    text = (laws / "__init__.py").read_text(encoding="utf-8")
    assert not [name for name in LAWS if f'"{name}"' in text or f"laws.{name} " in text]
    commands = ROOT / "src/calibrate/cli/commands"
    assert {path.stem for path in commands.glob("*.py")} - {"__init__"} == set(COMMANDS.values())
    assert set(COMMANDS) == set(build_parser()._subparsers._group_actions[0].choices)


def test_laws_have_values_in_the_one_other_file():
    from law_support import ARGUMENTS

    assert ARGUMENTS.keys() == LAWS.keys()


def test_no_module_binds_a_name_twice():
    """The second would silently take the place of the first."""
    for path in sorted((ROOT / "src").rglob("*.py")):
        names = []
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                names.append(node.name)
            elif isinstance(node, ast.Assign | ast.AnnAssign):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                inside = [each for target in targets for each in ast.walk(target)]
                names += [n.id for n in inside if isinstance(n, ast.Name)]
        assert len(names) == len(set(names)), (path.name, {n for n in names if names.count(n) > 1})


@pytest.mark.parametrize(
    "name", ["emulator.generators", "emulator.families", "emulator.laws", "calibrate.priors"]
)
def test_a_sub_module_is_there_before_anything_else_is_used(name):
    package, sub_module = name.split(".")
    code = f"import {package} as front; print(front.{sub_module}.__name__)"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.strip().endswith(sub_module)
