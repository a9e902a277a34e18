"""The documentation: every public name is on it, and it builds without a warning."""

import ast
import inspect
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import calibrate
import emulator
from calibrate.cli import build_parser
from calibrate.model_error.kinds import SYSTEMATIC_ERRORS

ROOT = Path(__file__).parents[1]
FRONT = ("AGENTS.md", "CONTRIBUTING.md", "docs/llms.txt")
"""Pages for those who come to the repository, besides README.md and docs/*.md."""


@pytest.mark.parametrize("package", [emulator, calibrate], ids=lambda p: p.__name__)
def test_every_public_name_is_documented(package):
    modules = [m for n in package.__all__ if inspect.ismodule(m := getattr(package, n))]
    for door in (package, *modules):
        bare = [n for n in door.__all__ if not inspect.getdoc(getattr(door, n))]
        assert not bare, door.__name__


def test_pages_are_reached():
    text = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"^[a-z_/]+$", text, flags=re.MULTILINE))
    pages = {path.stem for path in (ROOT / "docs").glob("*.md")} - {"index"}
    assert pages <= listed


def test_the_docs_have_every_kind_of_error_that_numbers_share():
    text = (ROOT / "docs" / "experiment_files.md").read_text(encoding="utf-8")
    kinds = set(re.findall(r"^\| `(\w+)` \|", text, flags=re.MULTILINE))
    assert kinds == set(SYSTEMATIC_ERRORS)


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path):
    for package in ("sphinx", "latex2mathml"):
        pytest.importorskip(package, reason=f"no {package} here")
    words = ["-W", "--keep-going", "-q", "-b", "html", ROOT / "docs", tmp_path]
    command = [sys.executable, "-m", "sphinx", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    page = (tmp_path / "generated" / "calibrate.html").read_text(encoding="utf-8")
    for name in calibrate.__all__:
        if not inspect.ismodule(getattr(calibrate, name)):
            assert f'id="calibrate.{name}"' in page, name
    for path in (ROOT / "docs").glob("*.md"):  # as llms.txt links them
        assert (tmp_path / path.name).read_bytes() == path.read_bytes()
    assert (tmp_path / "llms.txt").is_file()
    notation = (tmp_path / "notation.html").read_text(encoding="utf-8")
    assert notation.count("<math ") > 40
    assert re.findall(r'<script[^>]+src="(?:https?:)?//', notation) == []
    front = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert len(re.findall(r'<div class="card docutils', front)) == 12
    assert "Copyright &#169; 2026" in front


def test_no_line_of_prose_is_wider_than_100_characters():
    front = [ROOT / page for page in ("README.md", *FRONT)]
    for path in [*front, *(ROOT / "docs").glob("*.md")]:
        if path.name == "experiments.md":  # the log of what was tried keeps its lines
            continue
        text = re.sub(r"```.*?```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
        lines = text.splitlines()
        wide = [line for line in lines if len(line) > 100 and not line.startswith("|")]
        assert not wide, (path.name, wide[0])


def test_docs_and_notebooks_import_from_the_two_packages_only():
    """A user's code needs no module's path; a page shows files of the package with their docstring."""
    front = [ROOT / page for page in ("README.md", *FRONT)]
    pages = [*front, *(ROOT / "docs").glob("*.md")]
    code = {}
    for path in pages:
        blocks = examples(path.relative_to(ROOT))
        code[path.name] = "\n".join(block for block in blocks if not block.startswith('"""'))
    for path in (ROOT / "notebooks").glob("*.py"):
        code[path.name] = path.read_text(encoding="utf-8")
    deep = {
        name: found
        for name, text in code.items()
        if (
            found := re.findall(
                r"^\s*(?:from|import) (?:emulator|calibrate)\..*", text, re.MULTILINE
            )
        )
    }
    assert not deep


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 120


def test_contributing_is_short():
    assert len((ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8").splitlines()) <= 60


@pytest.mark.parametrize("page", ["README.md", *FRONT])
def test_links_of_the_front_pages_lead_somewhere(page):
    path = ROOT / page
    links = re.findall(r"\]\((?!https?:)([^)#]+)\)", path.read_text(encoding="utf-8"))
    assert [link for link in links if not (path.parent / link).exists()] == []


def test_llms_txt_has_the_form_of_llmstxt_org_and_every_page():
    text = (ROOT / "docs" / "llms.txt").read_text(encoding="utf-8")
    head, *sections = re.split(r"^## ", text, flags=re.MULTILINE)
    assert re.match(r"# [^\n]+\n\n> ", head)
    entries = [line for section in sections for line in section.splitlines()[1:] if line]
    names = [re.fullmatch(r"- \[[^\]]+\]\((\w+)\.md\): .+", line)[1] for line in entries]
    assert sorted(names) == sorted({p.stem for p in (ROOT / "docs").glob("*.md")} - {"index"})


def shell_lines(page):
    """Commands of a page's shell blocks, words as a shell splits them, without comments."""
    text = (ROOT / page).read_text(encoding="utf-8")
    blocks = re.findall(r"^```([^\n]*)\n(.*?)^```$", text, flags=re.DOTALL | re.MULTILINE)
    lines = "".join(block for language, block in blocks if language in ("", "sh"))
    lines = lines.replace("\\\n", " ")
    commands = [shlex.split(line, comments=True) for line in lines.splitlines()]
    return [words for words in commands if words]


@pytest.mark.parametrize("page", ["README.md", "docs/quickstart.md", "docs/tutorial.md", *FRONT])
def test_command_lines_are_words_that_the_commands_know(page):
    """Commands of this package are parsed; targets, modules and files of the others exist."""
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    lines = shell_lines(page)
    assert lines
    for words in lines:
        words = [word for word in words if not re.match(r"[A-Z_]+=", word)]
        if words[0] == "calibrate":
            build_parser(words[1]).parse_args(words[1:])
        elif words[0] == "make" and words[1] != ".venv/.installed":
            assert re.search(rf"^{words[1]}:", makefile, flags=re.MULTILINE), words
        elif words[0].endswith("python"):
            places = [word.replace(".", "/") + ".py" for word in words if "tests." in word]
            places += [word for word in words if word.startswith("tests/")]
            assert all((ROOT / place).exists() for place in places), words
            assert places, words
        else:
            assert words[0] in ("git", "make", "pip"), words


OWN_TESTS = {"README.md", "docs/extending.md", "docs/ecosystem.md"}
"""Pages whose examples other tests run."""
PAGES = sorted(
    page
    for path in (ROOT / "docs").glob("*.md")
    if "```python\n" in path.read_text(encoding="utf-8")
    and (page := f"docs/{path.name}") not in OWN_TESTS
)
NEED_MORE = {"families", "hearts", "released", "released_network"}
"""What needs Gmsh, released data or long training; pages show a call that does not run here."""


def examples(page, *, slow=True):
    """Python examples of a page; one that takes long is marked ``python slow``."""
    mark = "(?: slow)?" if slow else ""
    text = (ROOT / page).read_text(encoding="utf-8")
    return re.findall(rf"```python{mark}\n(.*?)```", text, flags=re.DOTALL)


def run_examples(page, *, slow=True):
    """Run the Python examples of a page one after the other; return what they define."""
    names = {}
    for number, code in enumerate(examples(page, slow=slow), 1):
        exec(compile(code, f"{page}, example {number}", "exec"), names)
    return names


def public_names(code):
    """Names of both packages that some code uses."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) in ("em", "cal"):
            yield node.attr
        elif isinstance(node, ast.ImportFrom):
            yield from (alias.name for alias in node.names)


# Pages whose examples take five seconds or more: compilation, nearly all.
LONG = (
    "accuracy",
    "analyses",
    "observations",
    "own_mesh",
    "populations",
    "quickstart",
    "unloading",
)


@pytest.mark.parametrize(
    "page",
    [
        *FRONT,
        *(pytest.param(p, marks=pytest.mark.slow if Path(p).stem in LONG else ()) for p in PAGES),
    ],
)
def test_the_quick_examples_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    run_examples(page, slow=False)


def test_every_public_name_is_in_an_example_that_runs():
    code = "\n".join(
        example for page in (*PAGES, "docs/extending.md") for example in examples(page, slow=False)
    )
    missing = {*emulator.__all__, *calibrate.__all__} - set(public_names(code))
    assert missing == NEED_MORE
    text = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "docs").glob("*.md"))
    assert [name for name in missing if not re.search(rf"\b(em|cal)\.{name}\b", text)] == []


@pytest.mark.slow
@pytest.mark.parametrize("page", ["docs/load_states.md", "docs/unloading.md"])
def test_the_examples_that_take_long_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_examples(page)


@pytest.mark.slow
@pytest.mark.parametrize("page", ["README.md", "AGENTS.md"])
def test_the_examples_of_the_first_pages_run(page, capsys):
    run_examples(page)
    assert "accepted" in capsys.readouterr().out


@pytest.mark.slow
def test_the_example_of_several_observations_runs(capsys):
    run_examples("docs/observations.md")
    assert 120.0 < float(capsys.readouterr().out.split()[-1]) < 180.0  # mL


@pytest.mark.slow
def test_the_quick_start_runs(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_examples("docs/quickstart.md")
    assert "accepted" in capsys.readouterr().out


@pytest.mark.slow
def test_the_examples_of_populations_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = run_examples("docs/populations.md")
    assert names["solution"].converged
    found = names["found"]
    assert abs(found.summary()["median[mu]"]["mean"] - 70.0) < 7.0
    assert found.summary()["median[mu]"]["r_hat"] < 1.02
