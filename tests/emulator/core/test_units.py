"""Units that data may be in by mistake: factors by another way than the table's."""

import pytest

from emulator.core.units import other_units


@pytest.mark.parametrize(
    ("unit", "factors"),
    [
        ("mm", {"m": 1000.0, "cm": 10.0, "µm": 0.001}),
        ("mm2", {"m2": 1000.0**2, "cm2": 10.0**2}),
        ("mL", {"mm3": 0.1**3, "L": 10.0**3, "m3": 100.0**3}),
        ("kPa", {"mmHg": 101.325 / 760.0, "Pa": 0.001, "MPa": 1000.0}),
        ("N", {"mN": 0.001, "gf": 9.80665e-3, "kN": 1000.0}),
        ("mN", {"N": 1000.0, "gf": 9.80665, "kN": 1e6}),
        ("1", {"%": 0.01}),
        ("1/s", {}),
    ],
)
def test_units_that_data_may_be_in_by_mistake(unit, factors):
    assert other_units(unit) == pytest.approx(factors, rel=1e-5)
