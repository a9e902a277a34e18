"""A new kind of observation is one class and one line of the registry, and then works everywhere."""

from dataclasses import dataclass

import arviz_base
import jax.numpy as jnp
import numpy as np
import pytest

import calibrate as cal
from calibrate.measurements import OBSERVATIONS, Scalar, observations_from_json, parse_observation
from calibrate.measurements.data import read_measurements, write_data
from calibrate.measurements.labels import labels_of
from calibrate.project import Run
from data_support import make_data
from emulator.core.errors import InputError
from linear_support import linear_forward


@dataclass(frozen=True, eq=False)
class Area(Scalar):
    """Area in mm2 between three nodes, asked for as ``area:3,14,20``."""

    corners: str
    nodes: np.ndarray
    points: np.ndarray

    kind = "area"
    quantity = "area"
    unit = "mm2"
    usual_sd = 0.1
    arguments = ("corners",)

    @classmethod
    def of(cls, scene, corners):
        nodes = cal.nodal_displacements(scene, [int(n) for n in corners.split(",")])
        return cls(corners, nodes.nodes, nodes.points)

    def evaluate(self, displacement, theta):
        x = self.points + displacement
        sides = x[..., 1:, :] - x[..., :1, :]
        return 0.5 * jnp.linalg.norm(jnp.cross(sides[..., 0, :], sides[..., 1, :]), axis=-1)


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    monkeypatch.setitem(OBSERVATIONS, "area", Area)  # the one line


def test_from_the_command_line_through_model_and_file_and_back(beam, tmp_path):
    observe = parse_observation(beam, "area:3,14,20+nodes:5", seed=1)
    assert list(observe.parts) == ["area:3,14,20", "displacement"]
    u = np.random.default_rng(0).normal(size=beam.mesh.nodes.shape)
    x = beam.mesh.nodes + u
    seen = observe(jnp.asarray(u[observe.nodes])[None], jnp.zeros((1, 2)))
    assert float(seen["area:3,14,20"]) == pytest.approx(
        0.5 * np.linalg.norm(np.cross(x[14] - x[3], x[20] - x[3])), rel=1e-12
    )
    data = {name: np.asarray(value) for name, value in seen.items()}
    for file in ("d.csv", "d.nc"):
        write_data(tmp_path / file, observe, data)
        back, values = read_measurements(beam, tmp_path / file)[:2]
        assert set(back.parts) == set(observe.parts)
        for name in data:
            np.testing.assert_array_equal(values[name], data[name])
    again = observations_from_json(beam, observe.to_json())
    np.testing.assert_array_equal(again.nodes, observe.nodes)
    # Labels in the DataTree: the area has no dimensions, the displacements keep theirs.
    constants, dims, coords = labels_of(observe)
    tree = arviz_base.from_dict(
        {"observed_data": data, "constant_data": constants}, dims=dims, coords=coords
    )
    assert tree["observed_data"]["area:3,14,20"].shape == ()
    assert tree["observed_data"]["displacement"].dims == ("point", "component")


def test_in_a_model_with_a_noise_of_its_own(beam):
    forward = linear_forward(beam)
    observe = parse_observation(beam, "area:3,14,20")
    model = cal.model(forward, observe, cal.GaussianNoise(sd_scale=0.2))
    assert model.names == ("mu", "lam", "noise_sd")
    theta = jnp.array([[70.0, 60.0]])
    value = model.predict({"mu": 70.0, "lam": 60.0})[0]["area:3,14,20"]
    checked = model.check_data(np.asarray(value))
    means = model.observe(model.forward(theta[0])[None], theta)
    density = model.log_density({"noise_sd": 0.5}, means, checked)
    assert float(density) == pytest.approx(-np.log(0.5 * np.sqrt(2.0 * np.pi)))
    with pytest.raises(InputError, match=r"area:3,14,20 is -1.0 mm2; it must be above 0"):
        model.check_data(-1.0)
    with pytest.raises(InputError, match=r"cm2 instead of mm2\? multiply by 100"):
        model.check_data(1e-2 * np.asarray(value))


def test_in_a_run(beam):
    run = Run(
        "once_clamped_beam", observe="area:3,14,20", noise=0.3, truth={"mu": 70.0, "lam": 60.0}
    )
    observe, data = make_data(run, beam)
    assert run.named(observe).noise == {"area:3,14,20": 0.3}
    assert Run("once_clamped_beam").named(observe).noise == {"area:3,14,20": 0.1}
    assert data["area:3,14,20"].shape == ()
    with pytest.raises(InputError, match="observe 'areas': give nodes:N.*area:CORNER,..."):
        parse_observation(beam, "areas")
    with pytest.raises(InputError, match="observe 'area:3,x': give area:CORNER,..."):
        parse_observation(beam, "area:3,x")
