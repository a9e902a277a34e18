"""Which commit made a page or a figure, and whether a figure is older than its code.

A figure's code is its study's folder, its notebook or ``pictures.py``. The figure is older if a
file of that code has changed since the figure's commit in more than comments and docstrings. The
files of both packages that this code calls by name, as ``em.Simulator``, are counted beside it.
Outside of a whole git checkout nothing is said.
"""

import ast
import inspect
import subprocess
from functools import cache
from pathlib import Path

from docutils import nodes

import calibrate
import emulator

ROOT = Path(__file__).resolve().parents[1]


def _git(*words, given=""):
    """Return what git prints about this checkout; an empty text where it refuses."""
    command = ["git", "-C", str(ROOT), *words]
    try:
        return subprocess.run(
            command, input=given, capture_output=True, text=True, check=True
        ).stdout
    except (OSError, subprocess.CalledProcessError):
        return ""


@cache
def commits():
    """Return the last commit of each file, with its day; nothing outside of a whole checkout."""
    if _git("rev-parse", "--is-shallow-repository").strip() != "false":
        return {}
    last, made = {}, ()
    for line in _git("log", "--format=\t%h\t%cs", "--name-only").splitlines():
        if line.startswith("\t"):
            made = line.split("\t")[1:]
        elif line:
            last.setdefault(line, made)
    return last


def source_of(page):
    """Return the file of the repository that a page, or a picture below ``docs``, is made of."""
    path = Path(page)
    kind, *rest = path.parts[1:] if path.parts[0] == "generated" else [""]
    if kind == "studies" and rest:
        return f"studies/{'/'.join(rest)}".replace("/index", "/README.md")
    if kind == "notebooks":
        return f"notebooks/{path.stem.rpartition('_')[0] if path.suffix else path.stem}.ipynb"
    if kind:
        return "CHANGELOG.md" if kind == "changelog" else None
    return f"docs/{page}" if path.suffix else f"docs/{page}.md"


def code_of(source):
    """Return the files that draw a figure."""
    path = ROOT / source
    if path.suffix == ".ipynb":
        return [path.with_suffix(".py")]
    if path.parent.name == "docs":
        return [path.parent / "pictures.py"]
    return sorted(path.parent.rglob("*.py"))


def named(files):
    """Return the files of both packages whose classes and functions some code calls by name."""
    doors, found = {"em": emulator, "cal": calibrate}, set()
    for file in files:
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            door, *names = ast.unparse(node).split(".") if isinstance(node, ast.Attribute) else [""]
            thing = doors.get(door)
            while names and inspect.ismodule(thing):
                thing = getattr(thing, names.pop(0), None)
            if inspect.isclass(thing) or inspect.isfunction(thing):
                path = Path(inspect.getsourcefile(thing))
                found |= {path} if path.is_relative_to(ROOT) else set()
    return found


@cache
def _statements(text):
    """Return a program without comments and docstrings."""
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            node.body = node.body[1 if ast.get_docstring(node) else 0 :]
    return ast.dump(tree)


def changed(files, commit):
    """Return the number of files whose statements are others than at a commit."""
    names = "".join(f"{commit}:{file.relative_to(ROOT)}\n" for file in files)
    rest, count = _git("cat-file", "--batch", given=names).encode(), 0
    for file in files:
        header, _, rest = rest.partition(b"\n")
        now, old = file.read_text(encoding="utf-8"), None
        if not header.endswith(b" missing"):
            size = int(header.split()[-1])
            old, rest = rest[:size].decode(), rest[size + 1 :]
        count += old is None or _statements(old) != _statements(now)
    return count


@cache
def sentence(source):
    """Return what is said of a figure, and whether it is older than its code; or None."""
    if source not in commits():
        return None
    commit, day = commits()[source]
    code = code_of(source)
    called = sorted(named(code))
    own, others = changed(code, commit), changed(called, commit)
    text = f"Figure of commit {commit}, {day}"
    if own:
        text += f"; older than its code: {own} of {len(code)} files changed since"
    if others:
        text += f"; of the packages' files that it calls, {others} of {len(called)} changed since"
    return f"{text}.", own > 0


def _under_figures(_app, doctree, _docname):
    """Put the sentence of each figure under it."""
    for image in list(doctree.findall(nodes.image)):
        uri = Path(image["uri"])
        source = source_of(uri.as_posix()) if not uri.is_absolute() else None
        said = sentence(source) if source else None
        if said is None:
            continue
        block = image
        while not isinstance(block, nodes.paragraph | nodes.figure) and block.parent is not None:
            block = block.parent
        classes = ["provenance", "older"] if said[1] else ["provenance"]
        block.parent.insert(
            block.parent.index(block) + 1, nodes.paragraph("", said[0], classes=classes)
        )


def _under_page(_app, pagename, _templatename, context, doctree):
    """Say at the end of a page at which commit its text and commands were written."""
    if doctree is not None and (source := source_of(pagename)) in commits():
        commit, day = commits()[source]
        said = f"Text and commands: {source} of commit {commit}, {day}."
        context["body"] += f'<p class="provenance">{said}</p>'


def setup(app):
    """Sphinx calls this."""
    app.connect("doctree-resolved", _under_figures)
    app.connect("html-page-context", _under_page)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
