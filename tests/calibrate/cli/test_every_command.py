"""Every command in a process of its own: one JSON document on stdout, and the right exit code."""

import json
import re
import shlex
import signal
import subprocess
import sys
from argparse import _SubParsersAction
from contextlib import closing
from http.client import HTTPConnection
from importlib.util import find_spec
from urllib.parse import urlsplit

import pytest

from calibrate.cli import COMMANDS, build_parser
from calibrate.project.specimen import draft_specimen
from cli_support import write_block
from surface_support import INSIDE, OUTSIDE, ellipsoid, write

BEAM = "once_clamped_beam --observe nodes:8 --noise 0.2"
INFER = f"infer {BEAM} --truth mu=70 lam=80 --warmup 100 --draws 100 --chains 2 --no-certify --out"
WORDS = [
    "campaign scene.toml --samples 2 --slopes --out runs.zarr",
    "certify one --draws 25 --no-mesh",
    f"check sbc {BEAM} --replicates 20 --warmup 50 --draws 50 --out sbc",
    f"check prior {BEAM} --out prior",
    "check mesh scene.toml --out mesh",
    "cohort subjects.csv --law neo_hookean --draws 100 --no-certify --out cohort",
    "compare one two",
    "completion bash",
    "demo --out demo",
    "effects scene.toml --observe nodes:4 --tolerance 0.1mm --samples 2",
    "evaluate once_clamped_beam --against fem --cases 2",
    "explore once_clamped_beam --no-browser",
    "export one --to felupe --mesh --out cards",
    "frames left_ventricle --surface endocardium@a=endo.stl --points 5 --out frames.csv",
    f"identify before {BEAM}",
    "identify after one --next nodes:4",
    f"{INFER} three",
    "init block.vtu --out new.toml",
    "mesh --endocardium endo.stl --epicardium epi.stl --size 12 --out lv.vtu",
    "predict once_clamped_beam --theta mu=70 lam=60",
    "released Liver --root PUBLISHED --out liver",
    "report one --no-fem",
    "scenes",
    "scenes ventricle_family",
    "schema",
    "schema experiment",
    "sensitivity once_clamped_beam --observe nodes:4 --samples 8",
    "serve once_clamped_beam --port 0",
    "simulate scene.toml --theta mu=7",
    "terms tests.toml",
    "train scene.toml --recipe mechanics --simulations 4 --out emulator",
    "unload scene.toml --theta mu=7 --out rest",
    "verify patch",
]
"""A cheap call of every command, in a folder with what it needs; there may be several."""
SERVE = ("explore", "serve")
NEED = {"mesh": "gmsh", "report": "plotly", "explore": "plotly"}


def kinds_of(parser):
    """The parsers of a parser's own commands, by name; none of a command without kinds."""
    actions = [each for each in parser._actions if isinstance(each, _SubParsersAction)]
    return actions[0].choices if actions else {}


def commands():
    """Every command with its parser; one with kinds is a command for each."""
    for name in COMMANDS:
        parser = kinds_of(build_parser(name))[name]
        kinds = kinds_of(parser) or {"": parser}
        yield from ((f"{name} {kind}".strip(), each) for kind, each in kinds.items())


def start(folder, words):
    code = "import sys; from calibrate.cli import main; sys.exit(main())"
    return subprocess.Popen(
        [sys.executable, "-c", code, *shlex.split(words), "--json"], cwd=folder, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A scene with its mesh, two surfaces, and two posteriors of the same data."""
    found = tmp_path_factory.mktemp("commands")
    write_block(found)
    rows = (f"{x},{y},{9 * (x - 1):.3f},{7 * (y - 1):.3f}" for x in (1.1, 1.2) for y in (1.1, 1.2))
    table = "stretch_x,stretch_y,stress_x [kPa],stress_y [kPa],protocol\n"
    lines = (f"{row},{k}\n" for k, row in enumerate(rows))
    (found / "tests.csv").write_text(table + "".join(lines))
    draft_specimen(found / "tests.csv", found / "tests.toml", law="invariant_terms")
    (found / "subjects.csv").write_text("subject,data\na,tests.csv\nb,tests.csv\n")
    write(found / "endo.stl", ellipsoid(INSIDE))
    write(found / "epi.stl", ellipsoid(OUTSIDE))
    for name in ("one", "two"):
        said, errors = start(found, f"{INFER} {name}").communicate()
        assert json.loads(said)["verdict"] == "not certified", errors
    return found


def test_every_command_has_its_words():
    lacking = [n for n, _ in commands() if not any(f"{w} ".startswith(f"{n} ") for w in WORDS)]
    assert not lacking


def test_examples_of_help_are_words_that_the_commands_know():
    examples = [
        example.split()
        for _, parser in commands()
        for example in re.findall(r"calibrate ((?:[\w.:/+=@-]+ ?)+)", parser.epilog or "")
    ]
    assert len(examples) > 15
    for words in examples:
        assert build_parser(words[0]).parse_args([*words, "--json"]).json, words


@pytest.mark.slow
@pytest.mark.parametrize("words", WORDS, ids=lambda words: " ".join(words.split()[:2]))
def test_stdout_is_one_json_document(folder, words, request):
    command = words.split()[0]
    if command in NEED and find_spec(NEED[command]) is None:
        pytest.skip(f"no {NEED[command]} here")
    if "PUBLISHED" in words:
        words = words.replace("PUBLISHED", str(request.getfixturevalue("published")))
    process = start(folder, words)
    if command in SERVE:
        lines = ""
        while not lines.endswith("\n}\n"):
            lines += process.stdout.readline()
        server = HTTPConnection(urlsplit(json.loads(lines)["address"]).netloc, timeout=300)
        with closing(server):
            server.request("GET", "/Info")
            server.getresponse().read()  # once it answers, Ctrl-C is its end
        process.send_signal(signal.SIGINT)
        said, errors = process.communicate(timeout=300)
        assert (said, process.returncode) == ("", 0), errors
        return
    said, errors = process.communicate()
    result = json.loads(said)
    usable = True
    if command == "cohort":
        usable = False  # nobody certified it
    elif command in ("certify", "demo"):
        usable = result["verdict"] == "accepted"
    elif "sbc" in words:
        usable = result["passed"]
    assert process.returncode == (0 if usable else 1), errors


@pytest.mark.slow
@pytest.mark.parametrize(
    "words", ["simulate nowhere", "simulate scene.toml --theta mu=x", "nothing"]
)
def test_bad_input_leaves_stdout_empty(folder, words):
    process = start(folder, words)
    said, errors = process.communicate()
    assert (said, process.returncode) == ("", 2)
    assert errors.startswith("calibrate: ")
    assert errors.count("\n") == 1
