import numpy as np
import pytest

import emulator as em
from calibrate.figures import pyplot
from calibrate.figures.evaluation import density_figure, surface_figure
from emulator.accuracy.comparison import Errors
from emulator.geometry.facets import flat_triangles
from emulator.geometry.refinement import to_quadratic
from scene_support import block


@pytest.fixture(autouse=True)
def closed():
    yield
    pyplot().close("all")


def ordered(colours):
    return np.round(colours, 6)[np.lexsort(np.round(colours, 6).T)]


def errors(scene, cases=10, scale=1e-2, seed=0):
    rng = np.random.default_rng(seed)
    thetas = np.asarray(scene.from_unit(rng.uniform(size=(cases, len(scene.parameters)))))
    draw = lambda *shape: scale * np.exp(rng.normal(size=(cases, *shape)))
    nodes, elements = len(scene.mesh.nodes), len(scene.mesh.elements)
    fields = {
        "err_u": draw(nodes),
        "err_F": draw(elements, 1),
        "err_I1": draw(elements, 1),
        "err_Pi": draw(),
        "err_V": draw(1),
    }
    return Errors(thetas, fields, 0)


def test_densities_and_their_marks():
    found = errors(block())
    figure = density_figure(found, "title")
    axes = figure.axes[0]
    median, upper, curve = (line.get_xdata() for line in axes.lines)
    values = found.fields["err_u"]
    assert median[0] == pytest.approx(np.median(values))
    assert upper[0] == pytest.approx(np.quantile(values, 0.975))
    # A density over the decades: log-normal here, so its peak is 1/(sd sqrt(2 pi)) up to smoothing.
    density = axes.lines[2].get_ydata()
    assert np.trapezoid(density, np.log10(curve)) == pytest.approx(1.0, abs=0.01)
    assert density.max() == pytest.approx(np.log(10.0) / np.sqrt(2.0 * np.pi), rel=0.1)
    assert sum(a.axison for a in figure.axes) == 5


def test_errors_that_are_all_zero_or_one_value_can_be_drawn():
    scene = block()
    nothing = errors(scene, scale=0.0)
    one = errors(scene, cases=1)
    for found in (nothing, one):
        density_figure(found, "").canvas.draw()
    surface_figure(scene.mesh, nothing.fields["err_u"].mean(axis=0), "").canvas.draw()


@pytest.mark.parametrize("order", [1, 2])
def test_the_surface_is_whole_and_coloured_by_its_nodes(order):
    from matplotlib import colormaps

    scene = block()
    if order == 2:
        scene = em.scenes.Scene(
            "fine", to_quadratic(scene.mesh), scene.law, scene.parameters, (), scene.supports
        )
    X = scene.mesh.nodes
    corners = X[flat_triangles(scene.mesh.surface)]
    edges = corners[:, 1:] - corners[:, :1]
    area = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).sum()
    assert area == pytest.approx(2.0 * (2.0 * 3.0 + 3.0 * 4.0 + 4.0 * 2.0))
    figure = surface_figure(scene.mesh, X[:, 0], "")  # an error that grows along x
    value = corners[:, :, 0].mean(axis=1)
    expected = colormaps["viridis"](value / value.max())
    for axes in figure.axes[:2]:
        found = axes.collections[0].get_facecolor()  # from far to near
        np.testing.assert_allclose(ordered(found), ordered(expected), atol=1e-6)
