"""What the page of a sheet says of its thickness."""

from types import SimpleNamespace

import numpy as np
import pytest

import calibrate as cal
from calibrate.measurements import observations
from calibrate.report.page import _sheet
from emulator.geometry.generators.box import box
from scene_support import between_plates


@pytest.mark.parametrize(("thickness", "said"), [(1.5, True), (20.0, False)])
def test_forces_on_a_sheet_tell_moduli_times_thickness(thickness, said):
    """Numbers of a sheet 1.5 mm thick whose modulus is 2, 4 or 6 kPa; N/m are kPa mm."""
    scene = between_plates(mesh=box((60.0, 40.0, thickness), (3, 2, 1)))
    model = SimpleNamespace(
        forward=SimpleNamespace(scene=scene),
        observe=observations(cal.Reaction(scene, "top", "x")),
    )
    draws = {"mu": np.array([[2.0, 4.0, 6.0]]), "shear": np.zeros((1, 3))}
    page = "".join(_sheet(SimpleNamespace(model=model, draws=lambda: draws)))
    assert said == ("a sheet, 1.5 mm thick" in page)
    assert said == ("6 (3.3 to 8.7)" in page)
