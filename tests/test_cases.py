"""The commands of docs/cases.md: each can be read, and each ends as the page says."""

import json
import re
import shlex
from pathlib import Path

import pytest

from calibrate.cli import build_parser, main
from calibrate.cli.model_words import model_of
from calibrate.load_states import known_thetas
from calibrate.run import Run
from calibrate.workflow import observed
from emulator.catalogue import find_scene

PAGE = (Path(__file__).resolve().parents[1] / "docs" / "cases.md").read_text(encoding="utf-8")
BLOCKS = [
    [shlex.split(line)[1:] for line in block.splitlines()]
    for block in re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)
]
INFER = [words for block in BLOCKS for words in block if words[0] == "infer"]


def name(words):
    return words[words.index("--out") + 1]


@pytest.mark.parametrize("words", INFER, ids=name)
def test_the_command_names_what_there_is(words):
    """Scene, parameters, observations and noises, without solving or sampling."""
    run = Run(**model_of(build_parser().parse_args(words)))
    scene = find_scene(run.scene)
    observe = observed(run, scene)
    assert run.noises(observe)
    assert known_thetas(scene, observe.states, {**run.known, **run.truth}).shape[1] == len(
        scene.parameter_names
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "block", BLOCKS, ids=lambda block: name(block[-1] if "--out" in block[-1] else block[0])
)
def test_the_case_ends_accepted_with_the_truth_among_the_likely(
    block, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    for words in block:
        assert main([*words, "--json"]) == 0, words
        result = json.loads(capsys.readouterr().out)
        if words[0] != "infer":
            continue
        assert result["verdict"] == "accepted"
        for parameter, row in result["parameters"].items():
            assert abs(row["mean"] - row["truth"]) < 3.5 * row["sd"], parameter
