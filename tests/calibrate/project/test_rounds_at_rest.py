"""What rounds begin with before their first run: the data of the undeformed body."""

import emulator as em
from calibrate.project import Run, infer

MOVED = """
mesh = "own.vtu"
law = "neo_hookean"
supports = [
    {node_set = "left"},
    {node_set = "right", displacement = [-1.0, 0.0, 0.0], amount = "pressed"},
]
parameters = {mu = {unit = "kPa", range = [50, 100]}, pressed = {unit = "", range = [0.1, 9]}}
constants = {lam = 60}
"""


def test_supports_that_move_past_the_elements_beside_them_begin_no_nan(tmp_path):
    """The body at rest with its end moved by 4 mm has inverted elements, of 2 mm, and no force."""
    em.write_mesh(tmp_path / "own.vtu", em.generators.box((20.0, 10.0, 10.0), (10, 1, 1)))
    (tmp_path / "own.toml").write_text(MOVED)
    run = Run(
        str(tmp_path / "own.toml"), forward="rounds", truth={"mu": 120.0},
        known={"pressed@a": 2.0, "pressed@b": 4.0}, observe="reaction:right:x",
        noise={"reaction:right:x": 0.05}, draws=200, seed=1,
    )  # fmt: skip
    mu = infer(run, check_map=False).summary()["mu"]
    assert abs(mu["mean"] - 120.0) < 3.0 * mu["sd"] < 15.0
