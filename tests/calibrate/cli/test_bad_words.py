"""Bad input to the command line: exit code 2, one clear line, and nothing left behind."""

import json
import shutil

import meshio
import numpy as np
import pytest

import emulator as em
from cli_support import SCENE, answer, complaint, write_block
from emulator.geometry.bodies.box import box
from emulator.surrogates.files import SHIPPED

FREE_END = em.scenes.once_clamped_beam().mesh.node_set("right").tolist()


@pytest.fixture
def block(tmp_path):
    return write_block(tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('unit = "kPa"', 'unit = "mmHg"', "parameter 'mu' is in mmHg; law 'neo_hookean' takes kPa"),
        ("lam = 30.0", "lam = -30.0", "parameter 'lam' is -30 kPa; it must be above 0"),
        ("lam = 30.0", "nu = 0.3", "parameter 'nu' is not one of law 'neo_hookean'"),
        ('law = "neo_hookean"', 'law = "guccione"', "law 'guccione' needs fibres"),
        ('kind = "gravity"', 'kind = "weight"', 'kind = "weight"; expected'),
        (
            'node_set = "left"',
            'node_set = "left"\nglue = 1',
            "unknown key 'glue'; known: components",
        ),
        (
            "[[loads]]",
            '[[supports]]\nnode_set = "left"\ndisplacement = [1, 0, 0]\n[[loads]]',
            "support on 'left' contradicts another one at node",
        ),
    ],
)
def test_bad_scene_files(capsys, block, old, new, message):
    assert old in SCENE
    block.write_text(SCENE.replace(old, new))
    said = complaint(capsys, "simulate", block)
    assert "scene.toml" in said
    assert message in said


def test_bad_meshes_in_scene_files(capsys, block):
    mesh = box((20.0, 10.0, 10.0), (2, 1, 1))
    solid = ("tetra", mesh.elements)
    brick = ("hexahedron", [[0, 1, 4, 3, 6, 7, 10, 9]])
    meshio.write(block.parent / "block.vtu", meshio.Mesh(mesh.nodes, [solid, brick]))
    assert "it has hexahedron cells" in complaint(capsys, "simulate", block)
    tags = [np.zeros(len(mesh.elements), int), np.array([7])]
    data = {"gmsh:physical": tags, "gmsh:geometrical": tags}
    file = meshio.Mesh(mesh.nodes, [solid, ("triangle", mesh.surface[:1])], cell_data=data)
    meshio.write(block.parent / "block.msh", file, file_format="gmsh22", binary=False)
    block.write_text(SCENE.replace("block.vtu", "block.msh"))
    assert "physical group 7 (triangles) has no name" in complaint(capsys, "simulate", block)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["simulate", "beam"], "scene 'beam' is unknown"),
        (["simulate", "missing.toml"], "missing.toml does not exist"),
        (
            ["simulate", "once_clamped_beam", "--theta", "mu=500", "lam=60"],
            "parameter 'mu' is 500 kPa",
        ),
        (["simulate", "once_clamped_beam", "--theta", "mu"], "'mu' is not name=number"),
        (["simulate", "once_clamped_beam", "--theta", "mu=60"], "no value for parameter 'lam'"),
        (["simulate", "once_clamped_beam", "--theta", "mu=60", "mu=70"], "'mu' is given twice"),
        (["simulate", "once_clamped_beam", "--out", "u.png"], "must end in .vtu"),
        (
            ["simulate", "once_clamped_beam", "--out", "/no/where/u.vtu"],
            "its folder does not exist",
        ),
        (["simulate", "published:OnceClampedBeam"], "with --root DIR"),
        (["campaign", "liver", "--out", "x.zarr"], "are required: --samples"),
        (["campaign", "liver", "--samples", "0", "--out", "x.zarr"], "0 samples with seed 0"),
        (["campaign", "liver", "--samples", "2", "--out", "x"], "name must end in .zarr"),
        (["campaign", "liver", "--samples", "2", "--seed", "-1", "--out", "x.zarr"], "seed -1"),
        (["train", "liver", "--campaign", "no.zarr", "--out", "x"], "no.zarr does not exist"),
        (["simulate"], "SCENE"),
        (["dance"], "'dance' is no command"),
        (["train", "liver", "--objective", "luck", "--out", "e"], "invalid choice: 'luck'"),
        (
            ["train", "once_clamped_beam", "--budget", "soon", "--out", "x"],
            "duration 'soon': give 90s, 15m, 2h or 1h30m",
        ),
        (["train", "liver", "--budget", "5", "--out", "x"], "5 what? give 5s or 5m"),
        (["train", "liver", "--budget", "5 ", "--out", "x"], "5 what? give 5s or 5m"),
        (["train", "liver", "--budget", "10 m", "--out", "x"], "duration '10 m': give 90s"),
        (["train", "liver", "--budget", "", "--out", "x"], "duration '': give 90s"),
        (["train", "liver", "--budget", "0s", "--out", "x"], "duration '0s' must be above 0"),
        (
            ["train", "once_clamped_beam", "--resume", "--budget", "", "--out", "x"],
            "--budget has no effect with --resume",
        ),
        (["train", "once_clamped_beam", "--steps", "-1", "--out", "x"], "steps is -1"),
        (
            ["train", "once_clamped_beam", "--resume", "--steps", "9", "--out", "x"],
            "--steps has no effect with --resume",
        ),
        (
            ["train", "once_clamped_beam", "--resume", "--start", "liver", "--out", "x"],
            "--start has no effect with --resume",
        ),
        (
            ["train", "twice_clamped_beam", "--start", "once_clamped_beam", "--out", "x"],
            "the emulator of 'once_clamped_beam' has no network to start from",
        ),
        (["train", "once_clamped_beam", "--resume", "--out", "x"], "nothing to resume"),
        (["train", "once_clamped_beam", "--steps", "9", "--seed", "-1", "--out", "x"], "seed -1"),
        (["train", "once_clamped_beam", "--steps", "9", "--out", "/dev/null/x"], "cannot write to"),
        (["demo", "--out", "/dev/null"], "cannot write to /dev/null"),
        (["evaluate", "once_clamped_beam", "--against", "fem", "--cases", "0"], "0 samples"),
        (["evaluate", "nothing", "--against", "fem"], "emulator 'nothing' is neither"),
        (["evaluate", "once_clamped_beam", "--against", "/no/OnceClampedBeam"], "is missing"),
        (["verify", "published", "/no/where"], "does not exist"),
        (["verify", "published"], "give the folder of the released data"),
        (["verify", "patches"], "case 'patches' is unknown; known: patch"),
        (["certify", "/no/where"], "run.json does not exist"),
        (["sensitivity", "once_clamped_beam"], "give something to observe, or ask for the field"),
        (["sensitivity", "liver", "--field", "--method", "luck"], "invalid choice: 'luck'"),
        (["sensitivity", "liver", "--field", "--seed", "-1"], "sensitivity: seed -1 is below 0"),
        (["sensitivity", "liver", "--field", "--group", "x"], "--group x: write NAME=A,B"),
        *(
            (["sensitivity", "once_clamped_beam", "--field", *words], message)
            for words, message in (
                (["--samples", "3"], "3 samples; give 2 or more, for sobol a power of two"),
                (["--samples", "0"], "0 samples; give 2 or more"),
                (["--group", "m=mu", "n=mu"], "'mu' is in two groups"),
                (["--group", "m=nu"], "'nu' is none of mu, lam"),
                (["--prior", "nowhere"], "prior 'nowhere' is unknown; known: box, ventricles"),
            )
        ),
        (["sensitivity", "once_clamped_beam", "--observe", "volume"], "has 0 cavities"),
        (["effects", "once_clamped_beam", "--tolerance", "1mm"], "are required: --observe"),
        *(
            (["effects", "once_clamped_beam", "--observe", "landmarks:4", *words], message)
            for words, message in (
                (["--tolerance", "1"], "tolerance in 1: nothing observed has that unit"),
                (["--tolerance", "mm"], "tolerance 'mm': write a number and its unit"),
                (["--tolerance", "1mm", "2mm"], "two are given in mm; give one for each unit"),
                (["--tolerance", "1mm", "--samples", "1"], "1 samples; give 2 or more"),
                (["--tolerance", "1mm", "--seed", "-1"], "effects: seed -1 is below 0"),
            )
        ),
        (["report", "/no/where"], "run.json does not exist"),
        (["report", ".", "--out", "page.pdf"], "the file name must end in .html"),
        (["explore", "nowhere"], "emulator 'nowhere' is neither shipped nor a folder"),
        (["explore", "once_clamped_beam", "--port", "70000"], "give another, or 0 for a free one"),
        (["init", "none.msh"], "mesh file none.msh does not exist"),
        (["compare", "nowhere"], "posterior.nc does not exist"),
        (["compare", "nowhere", "nowhere"], "a folder is given twice"),
        (["identify", "before", "once_clamped_beam", "--observe", "apex"], "observe 'apex': give"),
        (["identify", "after", "nowhere"], "run.json does not exist"),
        (["check", "sbc", "once_clamped_beam", "--observe", "nodes:20"], "are required: --out"),
        (["check", "sbc", "liver", "--seed", "-1", "--out", "x"], "seed is -1; it must be 0 or"),
        (
            ["check", "prior", "once_clamped_beam", "--observe", "volume", "--out", "x"],
            "0 cavities",
        ),
        (["predict", "nothing"], "emulator 'nothing' is neither shipped"),
        (["predict", "once_clamped_beam", "--theta", "mu=nan", "lam=60"], "give a finite number"),
        (["predict", "once_clamped_beam", "--theta", "nu=3"], "has no parameter 'nu'"),
        (["predict", "once_clamped_beam", "--out", "u.txt"], "must end in .vtu"),
        (["train", "liver", "--recipe", "luck", "--out", "x"], "invalid choice: 'luck'"),
        (["train", "liver", "--recipe", "family", "--out", "x"], "give it as the start, e.g. vent"),
        (
            ["train", "liver", "--simulations", "0", "--out", "x"],
            "0 simulations; a discrepancy mod",
        ),
        (["train", "liver", "--simulations", "-3", "--out", "x"], "-3 simulations"),
        (["train", "nowhere", "--out", "x"], "scene 'nowhere' is unknown; built in:"),
        (["train", "liver"], "are required: --out"),
        (["evaluate", "once_clamped_beam"], "are required: --against"),
        (["scenes", "luck"], "unrecognized arguments: luck"),
        (["simulate", "once_clamped_beam", "--load-steps", "0"], "0 load steps; give 1 or more"),
        (["simulate", "once_clamped_beam", "--theta", "mu=inf", "lam=60"], "mu' is inf kPa; scene"),
        (["demo", "--scene", "luck"], "invalid choice: 'luck'"),
        (["released", "nowhere"], "are required: --root, --out"),
        (["infer", "once_clamped_beam", "--out", "x"], "no value for parameter 'mu'"),
        *(
            (["infer", "once_clamped_beam", "--truth", "mu=73", "lam=61", *words, "--out", "x"], m)
            for words, m in (
                (["--sampler", "luck"], "invalid choice: 'luck'"),
                (["--draws", "0"], "draws is 0; it must be 1 or more"),
                (["--chains", "0"], "chains is 0; it must be 1 or more"),
                (["--seed", "-1"], "seed is -1; it must be 0 or more"),
                (["--sampler-options", "luck=1"], "has no option 'luck'; it has warmup, draws"),
                (["--forward", "luck"], "invalid choice: 'luck'"),
                (["--fem-runs", "9"], "--fem-runs has no effect without --forward reduced"),
                (
                    ["--forward", "reduced", "--fem-runs", "0"],
                    "fem_runs is 0; it must be 3 or more",
                ),
                (["--error-runs", "-1"], "error_runs is -1; it must be 0 or more"),
                (["--known", "E=3"], "has no parameter 'E'; it has mu, lam"),
                (["--prior", "luck"], "prior 'luck' is unknown; known: box, ventricles"),
                (["--data", "data.csv"], "data.csv does not exist"),
            )
        ),
    ],
)
def test_bad_calls(capsys, monkeypatch, tmp_path, words, message):
    monkeypatch.chdir(tmp_path)
    assert message in complaint(capsys, *words)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--data", "missing.csv"], "missing.csv does not exist"),
        (["--data", "inf.csv"], "row 2 has a displacement that is not finite"),
        (["--data", "gone.csv"], "gone.csv: data: every value of displacement is missing"),
        (["--data", "node.csv"], "node 4000 is unknown"),
        (["--data", "book.xlsx"], "book.xlsx is a spreadsheet; save it as CSV"),
        (["--data", "metres.csv"], "m instead of mm? multiply by 1000"),
        (["--data", "centimetres.csv"], "cm instead of mm? multiply by 10 "),
        (["--data", "zero.csv"], "displacement data are all zero; predictions reach"),
        (["--data", "huge.csv"], "times larger than predicted (largest 1e+09"),
        (["--truth", "mu=73", "mu=74", "lam=61"], "'mu' is given twice"),
        (
            ["--truth", "mu=73", "lam=61", "--noise", "volume=1.0"],
            "noise: 'volume' is not observed; observed: displacement",
        ),
        (["--truth", "mu=73", "lam=61", "--noise", "1", "2"], "--noise: '2' needs a name, as in"),
        (["--truth", "mu=73", "lam=61", "--noise", "much"], "--noise: 'much' is not a number"),
        (
            ["--truth", "mu=73", "lam=61", "--noise-scale", "displacement=0"],
            "displacement (mm): noise: standard deviation is 0.0",
        ),
        *(
            (["--truth", "mu=73", "lam=61", "--noise", noise], message)
            for noise, message in (
                ("student_t:dof=4", "'student_t:dof=4' needs a name, as in displacement=student_t"),
                ("displacement=pink:sd=1", "'pink:sd=1' is neither a number nor a noise; give gau"),
                ("displacement=student_t:dof=4", "noise: give either scale (known) or prior_scale"),
                ("displacement=correlated:length=0,sd=1,spatial_sd=1", "length (mm) is 0.0; it"),
            )
        ),
        *(
            (["--truth", "mu=73", "lam=61", "--discrepancy", word], message)
            for word, message in (
                ("displacement=1", "--discrepancy: 'displacement=1' is wrong; write it as in disp"),
                ("volume=1:20", "discrepancy: 'volume' is not observed; observed: displacement"),
                ("displacement=1:-20", "correlation length (mm) is -20.0; it must be above 0"),
            )
        ),
        (["--truth", "mu=73"], "no value for parameter 'lam'"),
        (["--truth", "mu=73", "lam=10"], "parameter 'lam' is 10 kPa"),
        (["--truth", "mu=73", "lam=61", "--observe", "4000"], "node 4000 is unknown"),
        (["--truth", "mu=73", "lam=61", "--observe", "apex"], "observe 'apex': give nodes:N"),
        (["--truth", "mu=73", "lam=61", "--observe", "nodes:x"], "'x' is not a number of nodes"),
        (
            ["--truth", "mu=73", "lam=61", "--observe", "nodes:9+volume"],
            "scene 'once_clamped_beam' has 0 cavities",
        ),
        (["--truth", "mu=73", "lam=61", "--observe", "all+right"], "displacement is given twice"),
        (
            ["--truth", "mu=73", "lam=61", "--noise", "-1"],
            "displacement (mm): noise: standard deviation is -1.0",
        ),
        (
            ["--truth", "mu=73", "lam=61", "--emulator", "broken"],
            "is truncated or not a safetensors",
        ),
        (["--truth", "mu=73", "lam=61", "--emulator", "other"], "was trained for a scene"),
    ],
)
def test_bad_inference_leaves_nothing_behind(capsys, monkeypatch, tmp_path, words, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "inf.csv").write_text("node,ux,uy,uz\n30,0,0,0\n31,0,inf,0\n")
    (tmp_path / "gone.csv").write_text("node,ux,uy,uz\n30,NA,,nan\n")
    (tmp_path / "node.csv").write_text("node,ux,uy,uz\n4000,0,0,0\n")
    (tmp_path / "book.xlsx").write_bytes(b"PK")
    # The free end sags by 10 to 20 mm.
    for name, sag in (("metres", 0.015), ("centimetres", 1.5), ("zero", 0.0), ("huge", 1e9)):
        rows = [f"{node},0,0,{-sag}" for node in FREE_END]
        (tmp_path / f"{name}.csv").write_text("\n".join(["node,ux,uy,uz", *rows]))
    for name in ("broken", "other"):
        shutil.copytree(SHIPPED / "once_clamped_beam", tmp_path / name)
    weights = tmp_path / "broken" / "weights.safetensors"
    weights.write_bytes(weights.read_bytes()[:5000])
    text = json.loads((tmp_path / "other" / "emulator.json").read_text())
    text["fingerprint"] = "0" * 16
    (tmp_path / "other" / "emulator.json").write_text(json.dumps(text))
    assert message in complaint(capsys, "infer", "once_clamped_beam", *words, "--out", "result")
    assert not (tmp_path / "result").exists()


def test_a_scene_without_a_shipped_emulator_says_so(capsys, block, tmp_path):
    line = complaint(
        capsys, "infer", block, "--truth", "mu=7", "--observe", "all", "--out", tmp_path / "r"
    )
    assert "is neither shipped nor a folder with emulator.json" in line


@pytest.mark.slow
def test_a_posterior_of_another_emulator_is_not_certified(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    from emulator.surrogates import load, save_emulator

    emulator = load("once_clamped_beam")
    save_emulator(emulator, "mine")
    words = ["--truth", "mu=73", "lam=61", "--emulator", "mine", "--warmup", 10, "--draws", 10]
    code, _ = answer(capsys, "infer", "once_clamped_beam", *words, "--no-certify", "--out", "r")
    assert code == 0
    from dataclasses import replace

    series = replace(emulator.taylor, displacement=1.01 * emulator.taylor.displacement)
    save_emulator(replace(emulator, taylor=series), "mine")
    assert "was made with another emulator map" in complaint(
        capsys, "certify", "r", "--draws", "30"
    )


def test_a_mesh_with_a_flat_element(capsys, block):
    mesh = box((20.0, 10.0, 10.0), (2, 1, 1))
    elements = mesh.elements.copy()
    elements[5, 3] = elements[5, 2]
    meshio.write(block.parent / "block.vtu", meshio.Mesh(mesh.nodes, [("tetra", elements)]))
    assert "block.vtu: element 5 has no volume, 1 such of 12" in complaint(
        capsys, "simulate", block
    )
