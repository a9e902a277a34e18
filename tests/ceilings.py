"""How much of what grows unseen there is in the source: mechanisms, names, long functions.

``python -m tests.ceilings`` prints each figure beside its ceiling. A ceiling is lowered by the
change that lowers its figure, and never raised: a new capability uses the mechanism that is there.
"""

from __future__ import annotations

import ast
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).resolve().parents[1]
WORDS = {"own": 0, "found": 0, "given": 2, "told": 0, "moved": 0, "each": 0}
"""Words that name nothing, each with the number of names that are called so at most.

The two of ``given`` are public: ``Model.given`` and the argument of ``specimen``.
"""

LONGEST = 60  # lines of a function, with its docstring
_SOLVES = {"solve", "inv", "lstsq", "cholesky", "cho_solve", "cho_factor", "solve_triangular"}
_FACTORS = {"mmHg", "kPa", "Pa", "mm", "cm", "m", "mL", "mm3", "mN", "N", "um", "µm"}


@cache
def sources() -> dict[str, ast.Module]:
    """Return the syntax tree of each file of the source, by its path in ``src``."""
    files = sorted((ROOT / "src").rglob("*.py"))
    return {
        str(path.relative_to(ROOT / "src")): ast.parse(path.read_text(encoding="utf-8"))
        for path in files
    }


def nodes[N: ast.AST](kind: type[N]) -> Iterator[tuple[str, N]]:
    """Yield every node of ``kind`` in the source, with its file."""
    for file, tree in sources().items():
        for node in ast.walk(tree):
            if isinstance(node, kind):
                yield file, node


def functions_of_modules_and_classes() -> Iterator[tuple[str, ast.FunctionDef]]:
    """Yield every function that is not nested in another one, with its file."""
    for file, tree in sources().items():
        scopes = [tree.body, *(node.body for node in tree.body if isinstance(node, ast.ClassDef))]
        for body in scopes:
            yield from ((file, node) for node in body if isinstance(node, ast.FunctionDef))


def ambiguous_classes() -> list[str]:
    """Return the class names that are used in more than one file."""
    files = defaultdict(set)
    for file, node in nodes(ast.ClassDef):
        files[node.name].add(file)
    return sorted(name for name, where in files.items() if len(where) > 1)


def long_functions() -> list[str]:
    """Return the functions of more than :data:`LONGEST` lines."""
    return [
        f"{file}:{node.name} {node.end_lineno - node.lineno + 1}"
        for file, node in nodes(ast.FunctionDef)
        if (node.end_lineno or 0) - node.lineno + 1 > LONGEST
    ]


def tables_of_units() -> list[str]:
    """Return the files that have factors between units, by a dictionary of units and numbers."""
    files = set()
    for file, node in nodes(ast.Dict):
        keys = {key.value for key in node.keys if isinstance(key, ast.Constant)}
        numbers = [value for value in node.values if isinstance(value, ast.Constant | ast.BinOp)]
        numeric = [v for v in numbers if not isinstance(getattr(v, "value", 0.0), str)]
        if keys & _FACTORS and numeric:
            files.add(file)
    return sorted(files)


def process_wide_objects() -> list[str]:
    """Return what one process has one of: changing containers and locks of a module, and caches.

    A cache of a module or class counts where it is called with objects: they are found again by
    identity or equality, and outlive what they follow from. One of a nested function ends with its
    call. ``emulator.core.kept`` keeps results with their owner.
    """
    made = re.compile(r"(\w*Lock|dict|list|set|defaultdict|Weak\w+)(\[.*\])?\(\)|\{\}|\[.*\]")
    objects = []
    for file, tree in sources().items():
        for node in tree.body:
            if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
                target = node.targets[0] if isinstance(node, ast.Assign) else node.target
                name = ast.unparse(target)
                changes = not name.strip("_").isupper() or ast.unparse(node.value) in ("{}", "[]")
                if changes and name != "__all__" and made.fullmatch(ast.unparse(node.value)):
                    objects.append(f"{file}:{name}")
    for file, node in functions_of_modules_and_classes():
        cached = [d for d in node.decorator_list if re.match(r"(lru_)?cache\b", ast.unparse(d))]
        simple = {"int", "float", "str", "bool", "tuple[int, ...]", "tuple[str, ...]"}
        types = {ast.unparse(a.annotation) for a in node.args.args if a.annotation}
        if cached and types - simple:
            objects.append(f"{file}:{node.name}")
    return objects


def modules_that_call(names: set[str], outside: tuple[str, ...] = ()) -> list[str]:
    """Return the files that call a function of one of ``names``, but those that begin with ..."""
    files = set()
    for file, node in nodes(ast.Call):
        function = node.func
        name = function.attr if isinstance(function, ast.Attribute) else ast.unparse(function)
        library = not isinstance(function, ast.Attribute) or "linalg" in ast.unparse(function)
        if name in names and library and not file.startswith(outside):
            files.add(file)
    return sorted(files)


def dense_solves() -> list[str]:
    """Return the files that solve dense systems: regressions, Newton steps, small matrices."""
    return modules_that_call(_SOLVES, ("emulator/fem/", "emulator/core/"))


def weighted_points() -> list[str]:
    """Return the files that weight points by densities of their own, besides the one engine."""
    return modules_that_call({"logsumexp"}, ("calibrate/importance/",))


def observation_members() -> list[str]:
    """Return the methods and attributes of the base class of observations."""
    from calibrate.measurements.observation import Observation

    return [name for name in vars(Observation) if not name.startswith("__") and name != "_abc_impl"]


def public_names() -> list[str]:
    """Return the names that ``import calibrate`` and ``import emulator`` offer."""
    import calibrate
    import emulator

    return sorted({*calibrate.__all__, *emulator.__all__})


@cache
def front_doors() -> dict[str, frozenset[str]]:
    """Return the names that a user may take from ``em`` and ``cal`` and their public sub-modules.

    A public sub-module is one that ``import emulator`` or ``import calibrate`` offers, as NumPy
    offers ``numpy.linalg``; its public names are those of its ``__all__``.
    """
    import calibrate
    import emulator

    doors = {}
    for short, package in (("em", emulator), ("cal", calibrate)):
        doors[short] = frozenset(package.__all__)
        for name in package.__all__:
            if isinstance(module := getattr(package, name), ModuleType):
                doors[f"{short}.{name}"] = frozenset(module.__all__)
    return doors


def names_of_submodules() -> list[str]:
    """Return the public names that only a public sub-module offers."""
    return [
        f"{door}.{name}"
        for door, names in front_doors().items()
        if "." in door
        for name in sorted(names - front_doors()[door.split(".")[0]])
    ]


def deep_imports_of_studies() -> list[str]:
    """Return what studies take from within the packages, past their front doors.

    Imports from a module of either package, and names that are in no public ``__all__``.
    """
    deep = []
    for path in sorted((ROOT / "studies").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            deep += [f"{path.parent.name}: {name}" for name in _past_the_door(node)]
    return deep


def _past_the_door(node: ast.AST) -> list[str]:
    packages = {"emulator": "em", "calibrate": "cal"}
    if isinstance(node, ast.Import):
        names = [alias.name for alias in node.names]
        return [name for name in names if name.split(".")[0] in packages and "." in name]
    if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in packages:
        offered = front_doors().get(packages.get(node.module, ""), frozenset())
        return [f"{node.module}.{a.name}" for a in node.names if a.name not in offered]
    if isinstance(node, ast.Attribute):
        door = ast.unparse(node.value)
        if door in front_doors() and node.attr not in front_doors()[door]:
            return [f"{door}.{node.attr}"]
    return []


def names_called(word: str) -> list[str]:
    """Return the files in which ``word`` names a variable, argument, attribute or function."""
    kinds = (ast.Name, ast.arg, ast.FunctionDef, ast.ClassDef)
    return [file for kind in kinds for file, node in nodes(kind) if _name(node).strip("_") == word]


def _name(node: ast.AST) -> str:
    if isinstance(node, ast.Name):
        return node.id if isinstance(node.ctx, ast.Store) else ""
    return node.arg if isinstance(node, ast.arg) else str(getattr(node, "name", ""))


def spine() -> list[str]:
    """Return the files from a law to a verdict, as ARCHITECTURE.md has them, in its order."""
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    chapter = text[text.index("## The spine") : text.index("## Floors")]
    return re.findall(r"`((?:emulator|calibrate)/[^`]+\.py)`", chapter)


def lines_of_spine() -> list[str]:
    """Return the lines of the spine's files."""
    files = [ROOT / "src" / file for file in spine()]
    return [line for file in files for line in file.read_text(encoding="utf-8").splitlines()]


FIGURES: dict[str, tuple[int, Callable[[], list[str]]]] = {
    "class names with two meanings": (0, ambiguous_classes),
    "files with a table of units": (1, tables_of_units),
    "objects and caches of the process": (2, process_wide_objects),
    "files that weight points": (5, weighted_points),
    "files that solve dense systems": (18, dense_solves),
    "members of Observation": (11, observation_members),
    "public names": (108, public_names),
    "names of public sub-modules": (145, names_of_submodules),
    "deep imports of studies": (0, deep_imports_of_studies),
    "files of the spine": (43, spine),
    "lines of the spine": (10_701, lines_of_spine),
    f"functions above {LONGEST} lines": (7, long_functions),
    **{f"names '{w}'": (most, partial(names_called, w)) for w, most in WORDS.items()},
}
"""Each figure's ceiling, and what it counts."""


def main() -> None:
    """Print each figure, its ceiling and what is counted."""
    for name, (ceiling, count) in FIGURES.items():
        items = count()
        print(f"{name}: {len(items)} (at most {ceiling})")
        if len(items) < 40:
            for item, times in Counter(items).items():
                print(f"    {item}" + (f" x {times}" if times > 1 else ""))


if __name__ == "__main__":
    main()
