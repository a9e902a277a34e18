"""The documentation site: ``make docs``.

Pages about public names, studies and notebooks are generated into ``docs/generated`` from
docstrings, READMEs and the notebooks with their outputs, so that they cannot say anything else.
"""

import base64
import inspect
import json
import re
import shutil
import sys
import tomllib
from collections.abc import Iterable
from pathlib import Path

import calibrate
import emulator

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))  # the extensions below
ROOT = HERE.parent
GENERATED = HERE / "generated"

project = "soft-tissue-calibrate"
author = "The soft-tissue-calibrate authors"
copyright = f"2026, {author}; MIT licence"
release = emulator.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
extensions += ["formulas", "provenance", "links"]
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3
exclude_patterns = ["_build", "generated/gallery.md"]
html_theme = "furo"
html_title = project
html_math_renderer = "mathml"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_extra_path = ["llms.txt"]
autodoc_member_order = "bysource"
autodoc_typehints = "none"
napoleon_numpy_docstring = True
napoleon_google_docstring = False
napoleon_use_rtype = False
# Pages are read in the repository, too, where they link to sources and folders.
suppress_warnings = ["myst.xref_missing", "myst.header"]


def _public(package: object) -> list[str]:
    """Lines of a page about every public name of a package."""
    title = f"``{package.__name__}``"
    lines = [title, "=" * len(title), "", f".. module:: {package.__name__}", ""]
    lines += _names(package, package.__name__, package.__all__)
    for name in package.__all__:
        module = getattr(package, name)
        if inspect.ismodule(module):
            path = f"{package.__name__}.{name}"
            lines += [f"``{path}``", "-" * (len(path) + 4), ""]
            lines += [module.__doc__.strip().splitlines()[0], ""]
            lines += _names(module, path, set(module.__all__) - set(package.__all__))
    return lines


def _names(module: object, door: str, names: Iterable[str]) -> list[str]:
    """Lines about the public names that ``door``, such as ``emulator.fem``, offers."""
    lines = []
    for name in sorted(names, key=str.lower):
        thing, path = getattr(module, name), f"{door}.{name}"
        if inspect.ismodule(thing):
            continue
        if isinstance(thing, dict):
            lines += [f".. data:: {name}", f"   :module: {door}", ""]
            lines += [f"   A registry: {', '.join(thing)}.", ""]
            continue
        kind = "class" if inspect.isclass(thing) else "function" if callable(thing) else "data"
        lines += [f".. auto{kind}:: {path}"]
        lines += ["   :members:"] if kind == "class" else []
        # The fields of a class whose data are a class of their own, such as those of a scene.
        bases = [base for base in getattr(thing, "__bases__", ()) if base.__name__ == f"{name}Data"]
        lines += ["", *(f".. autoclass:: {base.__module__}.{base.__name__}" for base in bases), ""]
    return lines


def _study(folder: Path) -> None:
    """A study's README with its pictures beside it."""
    target = GENERATED / "studies" / folder.name
    target.mkdir(parents=True)
    for picture in folder.glob("*.png"):
        shutil.copy(picture, target)
    text = (folder / "README.md").read_text(encoding="utf-8")
    # Links to sources lead nowhere on the site; their words stay.
    text = re.sub(r"(?<!!)\[([^\]]+)\]\((?!https?:)[^)]*\)", r"\1", text)
    (target / "index.md").write_text(text, encoding="utf-8")


def _notebook(path: Path) -> None:
    """A notebook's text, code and outputs, as they are in the repository."""
    target = GENERATED / "notebooks"
    target.mkdir(exist_ok=True)
    parts = []
    for number, cell in enumerate(json.loads(path.read_text(encoding="utf-8"))["cells"]):
        source = "".join(cell["source"]).replace("](../docs/", "](../../")
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            if "image/png" in data:
                picture = f"{path.stem}_{number}.png"
                (target / picture).write_bytes(base64.b64decode("".join(data["image/png"])))
                parts.append(f"![Figure of the cell above]({picture})")
                continue
            text = "".join(output.get("text", data.get("text/plain", "")))
            parts.append(f"```text\n{text.rstrip()}\n```")
    (target / f"{path.stem}.md").write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def _gallery() -> str:
    """Return the cards of ``gallery.toml``: a picture, a sentence and the command that makes it."""
    results = tomllib.loads((HERE / "gallery.toml").read_text(encoding="utf-8"))["results"]
    cards = [
        f":::{{container}} card\n[![{r['alt']}]({r['picture']})]({r['page']})\n\n"
        f"**[{r['title']}]({r['page']}).** {r['sentence']}\n\n```sh\n{r['command']}\n```\n:::\n"
        for r in results
    ]
    return "::::{container} gallery\n" + "\n".join(cards) + "::::\n"


def _generate() -> None:
    shutil.rmtree(GENERATED, ignore_errors=True)
    GENERATED.mkdir()
    for package in (emulator, calibrate):
        page = GENERATED / f"{package.__name__}.rst"
        page.write_text("\n".join(_public(package)), encoding="utf-8")
    (GENERATED / "gallery.md").write_text(_gallery(), encoding="utf-8")
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").replace("](docs/", "](../")
    (GENERATED / "changelog.md").write_text(changes, encoding="utf-8")
    for path in sorted(ROOT.glob("notebooks/*.ipynb")):
        _notebook(path)
    studies = sorted(path.parent for path in ROOT.glob("studies/*/README.md"))
    for folder in studies:
        _study(folder)
    entries = "\n".join(f"studies/{folder.name}/index" for folder in studies)
    (GENERATED / "studies.md").write_text(
        "# Studies\n\nEach asks one question, and is repeated by `python -m studies.<name>`.\n\n"
        f"```{{toctree}}\n:maxdepth: 1\n\n{entries}\n```\n",
        encoding="utf-8",
    )


_generate()

_ENTRY = re.compile(r"[A-Za-z_][\w, /()]* : ")


def _entries(_app, _what, _name, _thing, _options, lines):
    """Write ``name : meaning`` entries as numpydoc has them, or as a list outside a section."""
    found, inside, section = [], False, False
    for k, line in enumerate(lines):
        below = lines[k + 1] if k + 1 < len(lines) else ""
        section = section or (bool(below) and set(below) == {"-"})
        begins, rest = bool(_ENTRY.match(line)), inside and line.startswith(" ")
        name, _, meaning = line.partition(" : ")
        if section:
            found += [name, f"    {meaning}"] if begins else [line]
            continue
        if (begins and not inside) or (inside and not begins and not rest and line):
            found.append("")
        inside = begins or rest
        other = f"  {line.strip()}" if rest else line
        found.append(f"- **{name}** : {meaning}" if begins else other)
    lines[:] = found


def _sources(app, error):
    """Copy the pages' Markdown to the root of the site, where llms.txt links it."""
    if error is None:
        for path in HERE.glob("*.md"):
            shutil.copy(path, app.outdir)


def setup(app):
    """Sphinx calls this."""
    app.connect("build-finished", _sources)
    app.connect("autodoc-process-docstring", _entries, priority=1)  # before napoleon
