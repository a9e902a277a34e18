"""The commands of docs/cases.md: each can be read, and each ends as the page says."""

import json
import re
import shlex
from pathlib import Path

import pytest

from calibrate.cli import build_parser, main
from calibrate.cli.run_words import problem_of
from calibrate.statistical_model.load_states import known_thetas

PAGE = (Path(__file__).resolve().parents[1] / "docs" / "cases.md").read_text(encoding="utf-8")
BLOCKS = [
    [shlex.split(line)[1:] for line in block.splitlines()]
    for block in re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)
]
CLONE = "dalton2023"
INFER = [words for block in BLOCKS for words in block if words[0] == "infer"]


# By the --out of the command; all others are accepted.
REFUSED = dict.fromkeys(("isotropic", "liver", "strains", "infarct"), "not certified")


def name(words):
    return words[words.index("--out") + 1]


def on_this_machine(words, request):
    """``words`` with the folder of the released data; skipped where that is absent."""
    if CLONE not in words:
        return words
    root = str(request.getfixturevalue("published"))
    return [root if word == CLONE else word for word in words]


@pytest.mark.parametrize("words", [w for w in INFER if "--data" not in w], ids=name)
def test_the_command_names_what_there_is(words, request):
    """Scene, parameters, observations and noises, without solving, sampling or reading data."""
    words = on_this_machine(words, request)
    problem = problem_of(build_parser().parse_args(words))
    run, scene, states = problem.run, problem.scene, problem.observe.states
    assert run.noises(problem.observe)
    thetas = known_thetas(scene, states, {**run.known, **run.truth})
    assert thetas.shape[1] == len(scene.parameter_names)


@pytest.mark.slow
@pytest.mark.parametrize(
    "block", BLOCKS, ids=lambda block: name(block[-1] if "--out" in block[-1] else block[0])
)
def test_the_case_ends_as_the_page_says(block, request, tmp_path, monkeypatch, capsys):
    """Accepted with the truth among the likely, but for those of which the page says otherwise."""
    monkeypatch.chdir(tmp_path)
    for words in block:
        wrong = words[0] == "infer" and name(words) in REFUSED
        assert main([*on_this_machine(words, request), "--json"]) == (1 if wrong else 0), words
        result = json.loads(capsys.readouterr().out)
        if words[0] == "compare":
            assert result["verdict"].startswith("fibres predicts better")
        if words[0] != "infer":
            continue
        assert result["verdict"] == REFUSED.get(name(words), "accepted")
        for parameter, row in result["parameters"].items():
            if "truth" in row:
                assert abs(row["mean"] - row["truth"]) < 3.5 * row["sd"], parameter
