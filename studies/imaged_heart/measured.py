"""What is measured of a heart: an image at the end of diastole, and data with their errors.

Pressures by catheter, volumes of frames, Klotz's relation between the volume in the image and that
of a frame at half of its pressure, and circumferential strains since the image: of the chords
between neighbours among six points of the endocardium, on each of three levels. Chords, because a
coarse mesh has their lengths right to 0.005 of strain, and strains at points to 0.03.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from studies.imaged_heart.heart import (
    IMAGED,
    MUSCLE,
    SYSTOLIC,
    TENSION,
    at_rest,
    template,
)
from studies.imaged_heart.image import fitted

import calibrate as cal
import emulator as em

VOLUME_SD, STRAIN_SD = 3.0, 0.025  # mL, 1
READ_SD, FRAME_SD, SYSTOLIC_SD = (mmhg * em.loads.KPA_PER_MMHG for mmhg in (2.0, 1.0, 5.0))  # kPa
ANGLE, ANGLE_SD = {"endo": 60.0, "epi": -60.0}, 8.0  # degrees in the image, and their error
_LAW = tuple(p.name for p in MUSCLE if p.name not in ANGLE)
# What a mesh of a noisy image is off by, by trial; told to the model beside the data's error.
_IMAGE_VOLUME = 1.5  # mL
_LEVELS, _SECTORS = (0.25, 0.45, 0.65), 6  # of the height from the base on
_STRETCH = 1.1
_TRIES, _ROUNDS, _SETTLED = 200, 5, 1.5  # _SETTLED: degrees, by which no fibre turns any more


@dataclass(frozen=True, eq=False)
class Case:
    """One heart, and what is known of it.

    truth : parameters of the model's scene, and what follows from them. mesh : of the image.
    data, sd : by the names of :func:`observed`. chords : (18, 2) nodes of the mesh.
    """

    truth: dict[str, float]
    mesh: em.Mesh
    data: dict[str, Any]
    sd: dict[str, float]
    chords: np.ndarray
    read: float

    def observed(self, scene: em.Scene) -> dict[str, Any]:
        """What is observed of ``scene``, in which a loaded image may be the body at rest."""
        found: dict[str, Any] = {
            "volume:filling.endocardium": cal.CavityVolume(scene, "filling.endocardium"),
            "volume:systole.endocardium": cal.CavityVolume(scene, "systole.endocardium"),
            f"klotz:{self.read:.6g}": cal.KlotzVolume(scene, self.read),
        }
        for name, ends in zip(_names(self.mesh, self.chords), self.chords, strict=True):
            found[name] = cal.length_between(scene, *(str(len(self.mesh.nodes) + k) for k in ends))
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
    for _ in range(_TRIES):
        truth = _drawn(rng)
        try:
            found = _followed(truth)
        except em.SolverError:
            continue
        if found is not None and rng.random() < np.exp(-0.5 * _off(truth, found) ** 2):
            return _measured(truth, found, rng)
    raise em.InputError(f"no heart in {_TRIES} tries")


def _drawn(rng: np.random.Generator) -> dict[str, float]:
    """Parameters from their priors; the frame's pressure is half of that in the image."""
    drawn = {
        p.name: float(p.from_unit(jnp.asarray(rng.random())))
        for p in (*MUSCLE, SYSTOLIC, TENSION, IMAGED)
    }
    for name, rule in ANGLE.items():
        drawn[name] = rule + ANGLE_SD * float(np.clip(rng.normal(), -2.5, 2.5))
    return drawn | {"pressure": 0.5 * drawn["imaged"]}


class _Followed(NamedTuple):
    """Displacements from rest (n, 3) mm in the image, a frame and systole; volumes in mL."""

    image: np.ndarray
    frame: np.ndarray
    systole: np.ndarray
    volumes: list[float]


def _followed(truth: dict[str, float]) -> _Followed | None:
    """The heart of ``truth`` in its three states, with fibres by the rule in the image.

    The rule's angles are those in the image, so that fibres at rest are found with the image: the
    rule's on the last one, carried back by its F. ``None`` where that does not settle.

    Raises
    ------
    SolverError
        A state without an equilibrium.
    """
    scene = at_rest()
    muscle = [truth[p.name] for p in MUSCLE]
    fibres = np.asarray(scene.fibres_at(np.array([*muscle, 0.0, 0.0])))
    rule = em.scenes.Helix((truth["endo"], truth["epi"]))
    plain = replace(
        scene,
        parameters=tuple(p for p in scene.parameters if p.name not in ANGLE),
        angles=(),
        fibre_rule=None,
    )

    def solved(pressure: float, tension: float) -> np.ndarray:
        theta = plain.theta(**{p: truth[p] for p in _LAW}, pressure=pressure, tension=tension)
        found = em.Simulator(replace(plain, fibres=fibres)).solve(theta)
        return np.asarray(found.require_converged().displacement)

    for _ in range(_ROUNDS):
        u = solved(truth["imaged"], 0.0)
        there = rule.directions(replace(scene.mesh, nodes=scene.mesh.nodes + u))[0]
        F = np.eye(3) + np.asarray(scene.gradients(u))
        back = np.linalg.solve(F, there[..., None])[..., 0]
        back /= np.linalg.norm(back, axis=-1, keepdims=True)
        turned = np.degrees(np.arccos(np.clip(np.abs(np.sum(back * fibres, axis=-1)), 0.0, 1.0)))
        fibres = back
        if turned.max() < _SETTLED:
            break
    else:
        return None
    image, frame = solved(truth["imaged"], 0.0), solved(truth["pressure"], 0.0)
    systole = solved(truth["systolic"], truth["tension"])
    volume = cal.CavityVolume(scene)
    volumes = [float(volume(v[volume.nodes], None)) for v in (image, frame, systole)]
    return _Followed(image, frame, systole, volumes)


def _off(truth: dict[str, float], found: _Followed) -> float:
    """The image's volume beside the frame's curve, in sd of Klotz's relation."""
    ed, frame, _ = found.volumes
    klotz = cal.Klotz(ed, truth["imaged"])
    there = ed * frame / float(klotz.volume(truth["pressure"]))
    return (ed - there) / float(klotz.sd(truth["pressure"]))


def _measured(truth: dict[str, float], found: _Followed, rng: np.random.Generator) -> Case:
    """The image, and data with errors."""
    scene, coarse = at_rest(), template()
    there, u = cal.landmarks(scene, coarse.nodes), found.image
    nodes = [coarse.nodes + np.asarray(there(v[there.nodes], None)) for v in (u, found.systole)]
    seen = replace(coarse, nodes=nodes[0])
    mesh, chords = fitted(seen, rng), _chords(seen)
    stretch = _lengths(nodes[1], chords) / _lengths(nodes[0], chords)
    imaged_length = _lengths(mesh.nodes, chords)
    exact = {
        "volume:filling.endocardium": (found.volumes[1], VOLUME_SD),
        "volume:systole.endocardium": (found.volumes[2], VOLUME_SD),
        "parameter:pressure": (truth["pressure"], FRAME_SD),
        "parameter:systolic": (truth["systolic"], SYSTOLIC_SD),
        "parameter:imaged": (truth["imaged"], READ_SD),
    }
    for name, length, by in zip(_names(mesh, chords), imaged_length, stretch, strict=True):
        exact[name] = (by * length, STRAIN_SD * length)
    data = {n: v + error * rng.normal() for n, (v, error) in exact.items()}
    sd = {
        n: math.hypot(error, _IMAGE_VOLUME if n.startswith("volume") else 0.0)
        for n, (_, error) in exact.items()
    }
    read = float(np.clip(data["parameter:imaged"], IMAGED.low, IMAGED.high))
    at = float(np.clip(data["parameter:pressure"], 0.25 * read, read))
    name, ed = f"klotz:{read:.6g}", em.geometry.Cavity(mesh, "endocardium").rest
    data[name], sd[name] = ed, float(cal.Klotz(ed, read).sd(at))
    truth = truth | {
        "stiffness": float(fibre_stress(*(truth[n] for n in ("a", "b", "a_f", "b_f")))),
        "unloaded": em.geometry.Cavity(scene.mesh, "endocardium").rest,
    }
    return Case(truth, mesh, data, sd, chords, read)


def _chords(mesh: em.Mesh) -> np.ndarray:
    """Neighbours on each level of the endocardium, (18, 2) nodes."""
    inside = np.unique(mesh.facet_set("endocardium"))
    x, y, z = mesh.nodes[inside].T
    around, far = np.arctan2(y, x), np.hypot(x, y)
    found: list[tuple[int, int]] = []
    for share in _LEVELS:
        level = z.max() - share * np.ptp(z)
        ring = []
        for phi in np.linspace(0.0, 2.0 * np.pi, _SECTORS, endpoint=False):
            apart = np.abs(np.angle(np.exp(1j * (around - phi)))) * far
            ring.append(inside[np.argmin(np.hypot(apart, z - level))])
        found += zip(ring, np.roll(ring, -1), strict=True)
    return np.array(found)


def _names(mesh: em.Mesh, chords: np.ndarray) -> list[str]:
    """What the chords' lengths are called in the scene, where the body that contracts is second."""
    return ["length:{}:{}".format(*(chord + len(mesh.nodes))) for chord in chords]


def _lengths(nodes: np.ndarray, chords: np.ndarray) -> np.ndarray:
    """(18,) mm."""
    return np.linalg.norm(nodes[chords[:, 0]] - nodes[chords[:, 1]], axis=-1)
