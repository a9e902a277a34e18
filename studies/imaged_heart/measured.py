"""What is measured of a heart: an image at the end of diastole, and data with their errors.

Pressures by catheter, volumes of frames, circumferential strains of tagged images since that image,
and Klotz's relation between the volume in the image and that of a frame at half of its pressure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from studies.imaged_heart.heart import (
    IMAGED,
    MUSCLE,
    SYSTOLIC,
    TENSION,
    at_rest,
    imaged,
    template,
)
from studies.imaged_heart.image import depth, fitted

import calibrate as cal
import emulator as em
from emulator.errors import InputError
from emulator.fem.energy import displacement_gradient
from emulator.geometry.fibres import circumferential
from emulator.geometry.fibres import depth as depth_of_wall
from emulator.geometry.mesh import Mesh
from emulator.scenes import Scene
from emulator.scenes.loads import KPA_PER_MMHG

VOLUME_SD, STRAIN_SD = 3.0, 0.025  # mL, 1; of a segment's strain
READ_SD, FRAME_SD, SYSTOLIC_SD = (mmhg * KPA_PER_MMHG for mmhg in (2.0, 1.0, 5.0))  # kPa
ANGLE, ANGLE_SD = {"endo": 60.0, "epi": -60.0}, 8.0  # degrees in the image, and their error
_AT_REST = {"endo": 62.0, "epi": -52.0}  # filling turns fibres to about those of the image
_SEGMENTS = 18  # the points' strains together say as much as those of so many segments
_STRETCH = 1.1
_TRIES = 200


@dataclass(frozen=True, eq=False)
class Case:
    """One heart, and what is known of it.

    truth : parameters of the model's scene, and what follows from them. mesh : of the image.
    data, sd : by the names of :func:`observed`. points : (k, 3) mm, of strains.
    """

    truth: dict[str, float]
    mesh: Mesh
    data: dict[str, Any]
    sd: dict[str, float]
    points: np.ndarray
    read: float

    def observed(self, scene: Scene) -> dict[str, cal.observations.Observation]:
        """What is observed of ``scene``, in which a loaded image may be the body at rest."""
        shift = scene.mesh.nodes[len(self.mesh.nodes)] - self.mesh.nodes[0]
        found = {
            "volume:filling.endocardium": cal.CavityVolume(scene, "filling.endocardium"),
            "volume:systole.endocardium": cal.CavityVolume(scene, "systole.endocardium"),
            f"klotz:{self.read:.6g}": cal.KlotzVolume(scene, self.read),
            "strain": cal.strains(scene, ["circumferential"], self.points + shift),
        }
        for name in ("pressure", "systolic", "imaged"):
            if name in scene.parameter_names:
                found[f"parameter:{name}"] = cal.MeasuredParameter(scene, name)
        return found


def fibre_stress(a: Any, b: Any, a_f: Any, b_f: Any) -> Any:
    """kPa, first Piola, of a strip of muscle along its fibres, stretched by 10 %.

    With J = 1: a exp(b (I1 - 3)) (l - 1/l^2) + 2 a_f (l^2 - 1) exp(b_f (l^2 - 1)^2) l.
    """
    longer = _STRETCH**2 - 1.0
    matrix = np.exp(b * (_STRETCH**2 + 2.0 / _STRETCH - 3.0)) * (_STRETCH - _STRETCH**-2)
    return a * matrix + 2.0 * a_f * longer * np.exp(b_f * longer**2) * _STRETCH


def heart(seed: int) -> Case:
    """A heart whose curve is as likely as Klotz's relation and its scatter say."""
    rng = np.random.default_rng(seed)
    scene = at_rest()
    simulator, volume = em.Simulator(scene), cal.CavityVolume(scene)
    for _ in range(_TRIES):
        drawn = _drawn(rng)
        muscle = [drawn[p.name] for p in MUSCLE]
        solve = lambda p, T, muscle=muscle: simulator.solve(np.array([*muscle, p, T]))  # noqa: E731
        found = [solve(drawn["imaged"], 0.0), solve(drawn["pressure"], 0.0)]
        if not all(each.converged for each in found):
            continue
        ed, frame = (float(volume(each.displacement[volume.nodes], None)) for each in found)
        klotz = cal.Klotz(ed, drawn["imaged"])
        off = (ed - frame * ed / float(klotz.volume(drawn["pressure"]))) / float(
            klotz.sd(drawn["pressure"])
        )
        if rng.random() > np.exp(-0.5 * off**2):
            continue
        contracted = solve(drawn["systolic"], drawn["tension"])
        u, theta = found[0].displacement, np.array([*muscle, 0.0, 0.0])
        seen = _angles_in_image(scene, np.asarray(u), theta)
        if contracted.converged and all(p.low < seen[p.name] < p.high for p in MUSCLE[-2:]):
            return _measured(drawn | seen, u, frame, contracted.displacement, rng)
    raise InputError(f"no heart in {_TRIES} tries")


def _angles_in_image(scene: Scene, u: np.ndarray, theta: np.ndarray) -> dict[str, float]:
    """Degrees at endocardium and epicardium, of a line through the angles that ``u`` leaves.

    A rule on the image's mesh speaks of the fibres there; at rest they have other angles.
    """
    mesh = replace(scene.mesh, nodes=scene.mesh.nodes + u)
    F = np.eye(3) + np.asarray(displacement_gradient(scene, u))
    fibre = np.einsum("mqij,mqj->mqi", F, np.asarray(scene.fibres_at(theta)))
    across = depth_of_wall(mesh, ("endocardium",), ("epicardium",))
    around = circumferential(across.normal, np.array([0.0, 0.0, 1.0]))
    up = np.cross(across.normal, around)
    slope = np.sum(fibre * up, axis=-1) / np.sum(fibre * around, axis=-1)
    line = np.polyfit(across.value.ravel(), np.degrees(np.arctan(slope)).ravel(), 1)
    return {"endo": float(line[1]), "epi": float(line.sum())}


def _drawn(rng: np.random.Generator) -> dict[str, float]:
    """Parameters from their priors; the frame's pressure is half of that in the image."""
    drawn = {
        p.name: float(p.from_unit(jnp.asarray(rng.random())))
        for p in (*MUSCLE, SYSTOLIC, TENSION, IMAGED)
    }
    for name, rule in _AT_REST.items():
        drawn[name] = rule + ANGLE_SD * float(np.clip(rng.normal(), -2.5, 2.5))
    return drawn | {"pressure": 0.5 * drawn["imaged"]}


def _measured(
    truth: dict[str, float], u: Any, frame: float, contracted: Any, rng: np.random.Generator
) -> Case:
    """The image of displacement ``u``, and data with errors."""
    scene, coarse = at_rest(), template()
    u, contracted = np.asarray(u), np.asarray(contracted)
    there = cal.landmarks(scene, coarse.nodes)
    seen = replace(coarse, nodes=coarse.nodes + np.asarray(there(u[there.nodes], None)))
    mesh, middle = fitted(seen, rng), _middle_of_wall(seen)
    filled = replace(scene, mesh=replace(scene.mesh, nodes=scene.mesh.nodes + u), origin={})
    strain = cal.strains(filled, ["circumferential"], seen.nodes[middle])
    volume, point_sd = cal.CavityVolume(scene), STRAIN_SD * (len(middle) / _SEGMENTS) ** 0.5
    exact = {
        "volume:filling.endocardium": (frame, VOLUME_SD),
        "volume:systole.endocardium": (float(volume(contracted[volume.nodes], None)), VOLUME_SD),
        "strain": (np.asarray(strain((contracted - u)[strain.nodes], None)), point_sd),
        "parameter:pressure": (truth["pressure"], FRAME_SD),
        "parameter:systolic": (truth["systolic"], SYSTOLIC_SD),
        "parameter:imaged": (truth["imaged"], READ_SD),
    }
    sd = {name: error for name, (_, error) in exact.items()}
    data = {n: v + error * rng.normal(size=np.shape(v)) for n, (v, error) in exact.items()}
    read = float(np.clip(data["parameter:imaged"], IMAGED.low, IMAGED.high))
    at = float(np.clip(data["parameter:pressure"], 0.25 * read, read))
    filling = cal.CavityVolume(imaged(mesh), "filling.endocardium")
    name, ed = f"klotz:{read:.6g}", float(filling(np.zeros((len(filling.nodes), 3)), None))
    data[name], sd[name] = ed, float(cal.Klotz(ed, read).sd(at))
    truth = truth | {
        "stiffness": float(fibre_stress(*(truth[n] for n in ("a", "b", "a_f", "b_f")))),
        "unloaded": float(volume(np.zeros((len(volume.nodes), 3)), None)),
    }
    return Case(truth, mesh, data, sd, mesh.nodes[middle], read)


def _middle_of_wall(mesh: Mesh) -> np.ndarray:
    """Nodes half way through the wall, away from base and apex, (k,)."""
    height = mesh.nodes[:, 2]
    share = (height.max() - height) / np.ptp(height)
    return np.flatnonzero((depth(mesh) == 0.5) & (share > 0.2) & (share < 0.7))
