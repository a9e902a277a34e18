"""Names of data: what, where and in which load state."""

import numpy as np

import calibrate as cal
import emulator as em
from calibrate.measurements import parse_observation
from calibrate.measurements.collection import leave_out_missing, observations
from calibrate.measurements.labels import datum_names, missing_places
from calibrate.measurements.stress import Stress
from calibrate.measurements.surface import SurfacePoints
from emulator.specimens.specimen import specimen
from emulator.specimens.states import states


def test_points_are_named_by_place_component_and_state(beam):
    points = np.array([[20.0, 5.0, 5.0], [40.5, 2.0, 7.0]])
    observe = observations({"displacement@late": cal.landmarks(beam, points)})
    names = datum_names(observe, "displacement@late")
    assert names[1] == "displacement y at (20, 5, 5) mm in state late"
    assert names[5] == "displacement z at (40.5, 2, 7) mm in state late"
    gap = {"displacement@late": np.array([[1.0, np.nan, 1.0], [1.0, 1.0, 1.0]])}
    fewer, _ = leave_out_missing(observe, gap)
    assert datum_names(fewer, "displacement@late") == [names[0], *names[2:]]
    assert missing_places(fewer) == {"displacement@late": ["at (20, 5, 5) mm"]}
    flat = np.tile([1.0, 1.0, np.nan], (2, 1))  # as one camera sees it: nothing is missing
    fewer, _ = leave_out_missing(observe, {"displacement@late": flat})
    assert missing_places(fewer) == {}


def test_surfaces_segments_and_volumes(ventricle):
    part = SurfacePoints.of(ventricle, "endocardium", ventricle.mesh.nodes[:1], slack=np.inf)
    (name,) = datum_names(observations({"surface:endocardium@es": part}), "surface:endocardium@es")
    assert name.startswith("surface:endocardium at (")
    assert name.endswith(") mm in state es")
    assert datum_names(parse_observation(ventricle, "volume"), "volume") == ["volume"]
    strains = parse_observation(ventricle, "segment_strain:circumferential,radial")
    kind = "segment_strain"
    assert datum_names(strains, kind)[3] == "segment_strain radial in segment 2"


def test_rows_of_tests():
    columns = {"stretch_x": np.array([1.0, 1.1, 1.0, 1.3])}
    scene = specimen(
        states(columns, ["a", "a", "b", "b"]),
        law=em.find_law("neo_hookean_split"),
        parameters=(em.Parameter("mu", "kPa", 1.0, 20.0),),
        constants={"kappa": 100.0},
    )
    observe = observations(Stress.of(scene, "stress_x,stress_y"))
    assert datum_names(observe, "stress")[7] == "stress_y in row 4 of test b"
    # A component that a test has not is not missing.
    data = {"stress": np.array([[1, np.nan], [1, np.nan], [1.0, 2.0], [1.0, 2.0]])}
    assert missing_places(leave_out_missing(observe, data)[0]) == {}
