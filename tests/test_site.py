"""The site's own machinery: its gallery, its formulas, its links and what it says of commits."""

import re
import shlex
import sys
import tomllib
from importlib import import_module
from pathlib import Path

import pytest

from calibrate.cli import build_parser

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
RESULTS = tomllib.loads((DOCS / "gallery.toml").read_text(encoding="utf-8"))["results"]
NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e-?\d+)?")


@pytest.fixture
def part(monkeypatch):
    """A module of ``docs`` by its name."""
    monkeypatch.syspath_prepend(DOCS)
    yield import_module
    for name in ("formulas", "links", "provenance"):
        sys.modules.pop(name, None)


def in_repository(path):
    """Where the build takes a page or a picture from."""
    path = path.replace("/index.md", "/README.md")
    return ROOT / path.removeprefix("generated/") if "generated/" in path else DOCS / path


def test_the_gallery_has_twelve_results():
    assert len({result["title"] for result in RESULTS}) == 12


@pytest.mark.parametrize("result", RESULTS, ids=lambda result: result["title"])
def test_a_result_has_its_picture_its_command_and_numbers_that_its_source_has(result):
    assert in_repository(result["picture"]).is_file()
    assert len(result["alt"].split()) > 5
    words = shlex.split(result["command"])
    if words[0] == "calibrate":
        build_parser(words[1]).parse_args(words[1:])
    else:
        assert words[:2] == ["python", "-m"]
        assert (ROOT / words[2].replace(".", "/") / "__main__.py").is_file()
    source = ROOT / result["source"] if "source" in result else in_repository(result["page"])
    known = set(NUMBER.findall(source.read_text(encoding="utf-8")))
    numbers = NUMBER.findall(result["sentence"])
    assert numbers
    assert [number for number in numbers if number not in known] == []


def test_a_formula_becomes_mathml(part):
    pytest.importorskip("latex2mathml", reason="no latex2mathml here")
    mathml = part("formulas").mathml
    assert "<mfrac>" in mathml(r"\frac{a}{2 b}")
    assert 'alttext="a &lt; b"' in mathml("a < b")
    assert mathml(r"a &= b \\ c &= d", block=True).count("<mtr>") == 2
    for formula in (r"\fraq{a}{b}", r"\begin{gone}a & b\end{gone}"):
        with pytest.raises(ValueError, match="unknown command"):
            mathml(formula)


def test_links_that_lead_nowhere_are_found(part, tmp_path):
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "index.html").write_text('<p id="here"></p><img src="../no.png">')
    (tmp_path / "a.html").write_text(
        '<a href="sub/">1</a><a href="sub/index.html#here">2</a><a href="#gone">3</a>'
        '<a href="sub/index.html?q#not">4</a><a href="https://example.org/x">5</a>'
        '<a href="../outside.html">6</a><a href="mailto:a@b.c">7</a>'
    )
    broken, external = part("links").examine(tmp_path)
    assert broken == [
        ("a.html", "#gone"),
        ("a.html", "../outside.html"),
        ("a.html", "sub/index.html?q#not"),
        ("sub/index.html", "../no.png"),
    ]
    assert external == ["https://example.org/x"]


def test_pages_and_pictures_come_from_files_of_the_repository(part):
    source_of = part("provenance").source_of
    for page, source in {
        "faq": "docs/faq.md",
        "beam.png": "docs/beam.png",
        "generated/studies/sbc/index": "studies/sbc/README.md",
        "generated/studies/sbc/map.png": "studies/sbc/map.png",
        "generated/notebooks/real_beam": "notebooks/real_beam.ipynb",
        "generated/notebooks/real_beam_3.png": "notebooks/real_beam.ipynb",
        "generated/changelog": "CHANGELOG.md",
    }.items():
        assert source_of(page) == source
        assert (ROOT / source).is_file()
    assert source_of("generated/emulator") is None
    assert source_of("generated/studies") is None


def test_a_figure_is_older_than_statements_that_changed(part, tmp_path, monkeypatch):
    module = part("provenance")
    monkeypatch.setattr(module, "ROOT", tmp_path)
    study = tmp_path / "studies" / "one"
    study.mkdir(parents=True)
    code, picture = study / "__main__.py", study / "one.png"

    def committed(day):
        module._git("add", ".")
        who = ("-c", "user.name=a", "-c", "user.email=a@b.c")
        module._git(*who, "commit", "--quiet", "-m", "x", "--date", day)
        module.commits.cache_clear()
        module.sentence.cache_clear()

    code.write_text('"""A study."""\n\nSIZE = 1\n')
    picture.write_bytes(b"picture")
    assert module.sentence("studies/one/one.png") is None  # no checkout
    module._git("init", "--quiet")
    committed("2026-01-01T00:00")
    assert not module.sentence("studies/one/one.png")[1]
    code.write_text('"""Another text."""\n\n# A reason.\nSIZE = 1\n')
    committed("2026-01-02T00:00")
    assert not module.sentence("studies/one/one.png")[1]
    code.write_text("SIZE = 2\n")
    committed("2026-01-03T00:00")
    text, older = module.sentence("studies/one/one.png")
    assert older
    assert text.endswith("older than its code: 1 of 1 files changed since.")
    assert module.commits()["studies/one/one.png"][0] in text
