"""Tables fit the terminal they are printed on."""

import pytest

from calibrate.cli.commands.evaluate import evaluation_summary
from calibrate.cli.commands.posteriors import comparison_summary
from calibrate.cli.output import posterior_summary, table
from calibrate.posterior.comparison import Compared, Comparison

PARAMETERS = {
    name: {"truth": 1.2345e-5, "mean": -1.2345e-5, "sd": 1.5e-6, "low": -2e-5, "high": 2e-5,
           "r_hat": 1.001, "ess_bulk": 12345.0}
    for name in ("pressure@end_diastole", "noise_sd_displacement@end_diastole")
}  # fmt: skip
POSTERIOR = {
    "parameters": PARAMETERS, "chains": 4, "draws": 1000, "divergences": 0, "forward": "emulator", "map": "emulator",
}  # fmt: skip
SHIFTS = {"shift": dict.fromkeys(PARAMETERS, -0.0123)}


def test_narrow_tables_are_one_block():
    text = table(("name", "a", "b"), [("x", 1.0, 2), ("long", 0.25, None)], 80)
    assert text == "name     a  b\nx        1  2\nlong  0.25"


def test_columns_that_do_not_fit_go_below():
    header, row = ("name", *"abcdef"), ("x", *range(100, 106))
    blocks = table(header, [row], 16).split("\n\n")
    assert [block.splitlines()[0].split() for block in blocks] == [
        ["name", "a", "b"], ["name", "c", "d"], ["name", "e", "f"]
    ]  # fmt: skip
    assert max(len(line) for block in blocks for line in block.splitlines()) <= 16
    assert len(table(header, [row], 3).split("\n\n")) == 6  # never less than a column


def test_the_terminal_decides(monkeypatch):
    header, row = ("name", *"abcdef"), ("x", *range(100, 106))
    monkeypatch.delenv("COLUMNS", raising=False)
    assert "\n\n" not in table(header, [row])  # a pipe has no width
    monkeypatch.setenv("COLUMNS", "20")
    assert "\n\n" in table(header, [row])


def evaluated():
    units = {"err_u": "mm", "err_V:right_ventricle": "% of the volume"}
    errors = {name: dict.fromkeys(("median", "mean", "q97_5", "max"), 1.234e-12) for name in units}
    about = {"units": units, "label": "emulator", "reference": "fem", "invalid": 0}
    return evaluation_summary({"cases": 12345, **about, **errors})


def compared():
    models = tuple(
        Compared(f"runs/{name}_of_the_ventricle", *[-1234.5] * 6, 3, -1234.5, 0.5)
        for name in ("holzapfel_ogden", "neo_hookean")
    )
    return comparison_summary(Comparison(models, 73)).split("leave-one-out")[0]


@pytest.mark.parametrize(
    "text",
    [
        pytest.param(lambda: posterior_summary(POSTERIOR), id="infer"),
        pytest.param(
            lambda: table(
                (
                    "parameter",
                    "truth",
                    "mean",
                    "sd",
                    "5 %",
                    "95 %",
                    "R-hat",
                    "ESS",
                    "FEM/sd",
                    "mesh/sd",
                ),
                [
                    (name, *row.values(), SHIFTS["shift"][name], -SHIFTS["shift"][name])
                    for name, row in PARAMETERS.items()
                ],
            ),
            id="certify",
        ),
        pytest.param(evaluated, id="evaluate"),
        pytest.param(compared, id="compare"),
    ],
)
def test_eighty_columns(monkeypatch, text):
    monkeypatch.setenv("COLUMNS", "80")
    assert max(map(len, text().splitlines())) <= 80
