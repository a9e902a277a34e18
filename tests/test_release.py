"""Versions and workflows: what a release and the checks of a change rest on."""

import re
from pathlib import Path

import pytest

from release_check import main, problems, versions

ROOT = Path(__file__).resolve().parents[1]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
PROJECT = '[project]\nversion = "1.2.0"\n'
CITATION = "cff-version: 1.2.0\nversion: 1.2.0\ndate-released: 2027-01-31\n"
CHANGELOG = "# Changelog\n\n## 1.2.0 (2027-01-31)\n\n## 1.1.0 (2026-12-01)\n"


def sentences(changelog=CHANGELOG, citation=CITATION, tag=""):
    return list(problems(versions(PROJECT, changelog, citation), tag))


def test_the_versions_of_this_repository_agree(capsys):
    assert main() == 0
    assert capsys.readouterr().out.startswith("version ")


def test_a_release_that_is_in_order_has_no_problem():
    assert sentences() == sentences(tag="v1.2.0") == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"changelog": "## 1.3.0 (2027-01-31)\n"}, "CHANGELOG.md has version 1.3.0"),
        ({"changelog": "# Changelog\n"}, "CHANGELOG.md has version none, pyproject.toml 1.2.0"),
        ({"citation": "version: 1.1.0\n"}, "CITATION.cff has version 1.1.0"),
        ({"tag": "v1.2"}, "the tag is v1.2, .*: tag it v1.2.0"),
        ({"tag": "v1.2.0", "changelog": "## 1.2.0 (unreleased)\n"}, "begin it with '## 1.2.0"),
        ({"tag": "v1.2.0", "citation": "version: 1.2.0\n"}, "add 'date-released: YYYY-MM-DD'"),
        ({"tag": "v1.2.0", "changelog": "## 1.2.0 (2027-02-01)\n"}, "says 2027-02-01, CITATION"),
    ],
)
def test_what_disagrees_is_said_in_one_sentence(change, message):
    (sentence,) = sentences(**change)
    assert re.search(message, sentence)
    assert "\n" not in sentence


def test_an_unreleased_version_may_be_built_without_a_tag():
    assert sentences(changelog="## 1.2.0 (unreleased)\n", citation="version: 1.2.0\n") == []


def test_there_are_the_four_workflows():
    assert [path.stem for path in WORKFLOWS] == ["ci", "docs", "nightly", "release"]


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_a_workflow_calls_targets_that_exist_and_actions_of_a_major_version(path):
    yaml = pytest.importorskip("yaml", reason="no PyYAML here")
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 40
    workflow = yaml.safe_load(text)
    assert workflow["permissions"] == {"contents": "read"}
    steps = [step for job in workflow["jobs"].values() for step in job["steps"]]
    assert all(job["timeout-minutes"] for job in workflow["jobs"].values() if "needs" not in job)
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for command in (step["run"] for step in steps if "run" in step):
        program, target, *_ = command.split()
        assert program == "make"
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target
        assert "${{" not in command  # a name of a branch or tag is no part of a script
    for action in (step["uses"] for step in steps if "uses" in step):
        assert re.fullmatch(r"[\w-]+/[\w-]+@(release/)?v\d+", action), action
    assert "secrets." not in text


def test_the_tests_run_on_three_pythons_from_the_oldest_on():
    yaml = pytest.importorskip("yaml", reason="no PyYAML here")
    workflow = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text(encoding="utf-8"))
    pythons = workflow["jobs"]["test"]["strategy"]["matrix"]["python"]
    assert pythons == ["3.12", "3.13", "3.14"]
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert f'requires-python = ">={pythons[0]}"' in project
