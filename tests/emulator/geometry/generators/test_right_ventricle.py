import numpy as np
import pytest

from emulator.core.errors import InputError
from emulator.geometry.generators.biventricle import RightVentricle, Septum
from emulator.geometry.generators.ellipsoid import HUMAN

SEPTUM = Septum(HUMAN, RightVentricle(bulge=20.0, thickness=4.0))
TOP = np.array([0.0]), np.array([1.0])


def test_the_free_wall_bulges_most_in_the_middle_of_the_base():
    for s, wanted in ((0.0, 20.0), (1.0, 24.0)):
        x, y, z = SEPTUM.sheet(*TOP, np.array([s]))[0]
        epicardium = HUMAN.short_epicardium * np.sqrt(
            1.0 - (HUMAN.base / HUMAN.long_epicardium) ** 2
        )
        assert x == pytest.approx(epicardium + wanted)
        assert y == pytest.approx(0.0)
        assert z == pytest.approx(HUMAN.base)


@pytest.mark.parametrize("s", [0.0, 0.5, 1.0])
def test_its_edge_stands_on_the_epicardium(s):
    along = np.linspace(0.0, 1.0, 7)
    xi = np.concatenate([np.ones(7), -np.ones(7), 2.0 * along - 1.0])
    eta = np.concatenate([along, along, np.zeros(7)])
    r, phi = SEPTUM.foot(xi, eta, np.array([s]))
    on = HUMAN.position(r, phi, np.ones_like(r))
    np.testing.assert_allclose(SEPTUM.sheet(xi, eta, np.full(21, s)), on, atol=1e-12)


def test_it_is_as_thick_as_it_says_where_it_stands():
    # Measured along the epicardium, which is curved: the chord is a little shorter.
    for xi, eta in ((0.0, 0.0), (1.0, 1.0)):
        inside, outside = (
            SEPTUM.sheet(np.array([xi]), np.array([eta]), np.array([s]))[0] for s in (0.0, 1.0)
        )
        assert np.linalg.norm(outside - inside) == pytest.approx(4.0, rel=0.03)


def test_bad_dimensions_are_named():
    with pytest.raises(InputError, match="expected a half angle below 150 degrees"):
        RightVentricle(half_angle=180.0)
    with pytest.raises(InputError, match="positive bulge and thickness"):
        RightVentricle(thickness=0.0)
