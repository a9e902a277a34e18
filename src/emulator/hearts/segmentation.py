r"""Surfaces of the labels of a segmented image.

Voxels of a label are 1 and others 0. A Gaussian of standard deviation sigma in mm, the same along
every edge of a voxel whatever its length, blurs this field to f, and marching cubes (Lorensen and
Cline 1987, Marching cubes) find the surface ``f = c``. Blurring shrinks what is curved, so the
level c is that at which the surface encloses the volume of the voxels,

.. math:: |\{x : f(x) > c\}| = n\, |\det A| ,

with n voxels and the affine A. The image is padded, so that a label at its border is closed there.

In a left ventricle the surface of the blood is the endocardium, that of blood and myocardium
together the epicardium. Where blood touches neither, the ventricle is open: outward faces of these
voxels have the area vector of the opening's rim, which is the long axis, and the base plane goes
below the lowest of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_fill_holes, find_objects, gaussian_filter, label
from scipy.optimize import brentq

from emulator.core.errors import InputError
from emulator.core.units import MM3_PER_ML
from emulator.geometry.mesh import parts
from emulator.hearts.images import NEEDED, LabelImage
from emulator.hearts.surfaces import Surface, place_of, surface

try:
    from skimage.measure import marching_cubes
except ModuleNotFoundError as error:
    raise InputError(NEEDED) from error

_BLUR = 0.7  # of the cube root of a voxel's volume: takes steps off and keeps walls of two voxels
_TRUNCATE = 4.0  # standard deviations, where the Gaussian ends
_ENDS = 0.02  # of the field's maximum, from either end: levels that are tried
_MISSED = 1e-3  # of the volume, by which a surface may miss that of its voxels


class VentricleSurfaces(NamedTuple):
    """Closed surfaces of a left ventricle, and its base plane.

    axis : (3,) from apex to base, of length 1. base : (3,) mm, a point of the base plane.
    notes : volumes, and what was dropped, a line each.
    """

    endocardium: Surface
    epicardium: Surface
    axis: np.ndarray
    base: np.ndarray
    notes: tuple[str, ...]


def label_surface(
    image: LabelImage, labels: Sequence[int], name: str, blur: float | None = None
) -> tuple[Surface, list[str]]:
    """Return the closed surface of the largest piece of ``labels`` together, and notes.

    Parameters
    ----------
    image : the label image.
    labels : the labels, one or more, whose voxels are one body.
    name : the name of the surface in messages.
    blur : the standard deviation of the Gaussian, mm; by default 0.7 of the cube root of a voxel's
        volume. 0 keeps the steps.

    Raises
    ------
    InputError
        A label that the image lacks, or a body too thin for ``blur``.
    """
    mask, notes = largest_piece(image, labels, name)
    return mask_surface(image, mask, name, blur), [*image.notes, *notes]


def largest_piece(
    image: LabelImage, labels: Sequence[int], name: str
) -> tuple[np.ndarray, list[str]]:
    """Return the largest piece of ``labels``, its holes filled, as a mask, and notes."""
    mask, unit = image.mask(labels), image.voxel / MM3_PER_ML
    pieces, count = label(mask)  # joined by faces
    sizes = np.bincount(pieces.ravel())[1:]
    largest = pieces == 1 + np.argmax(sizes)
    whole = binary_fill_holes(largest)
    dropped, filled = sizes.sum() - sizes.max(), whole.sum() - sizes.max()
    notes = [f"{name}: {whole.sum() * unit:.4g} mL in {whole.sum()} voxels"]
    if dropped:
        pieces_dropped = "1 smaller piece" if count == 2 else f"{count - 1} smaller pieces"
        notes.append(f"{name}: {pieces_dropped} of {dropped * unit:.3g} mL dropped")
    if filled:
        notes.append(f"{name}: holes of {filled * unit:.3g} mL filled")
    if any(np.take(whole, end, axis=k).any() for k in range(3) for end in (0, -1)):
        notes.append(f"{name}: cut flat by the image's border; is all of it in the image?")
    return whole, notes


def mask_surface(
    image: LabelImage, mask: np.ndarray, name: str, blur: float | None = None
) -> Surface:
    """Return the surface around the voxels of ``mask`` (i, j, k), of which one or more are true."""
    if blur is not None and not 0.0 <= blur < np.inf:
        raise InputError(f"blur {blur} mm: expected a standard deviation of 0 mm or more")
    sigma = (_BLUR * np.cbrt(image.voxel) if blur is None else blur) / image.spacing
    (box,) = find_objects(mask.astype(np.int8))
    pad = np.ceil(_TRUNCATE * sigma).astype(int) + 2
    field = np.pad(mask[box].astype(np.float64), [(n, n) for n in pad])
    field = gaussian_filter(field, sigma, truncate=_TRUNCATE)
    count = int(mask.sum())

    def missed(level: float) -> float:
        return _enclosed(*_contour(field, level)) / count - 1.0

    low, high = _ENDS * field.max(), (1.0 - _ENDS) * field.max()
    if missed(low) > 0.0 > missed(high):
        points, triangles = _contour(field, brentq(missed, low, high, xtol=1e-5 * high))
        start = np.array([part.start for part in box]) - pad
        to_mm = image.affine[:3, :3], image.affine[:3, 3]
        smooth = surface(name, (points + start) @ to_mm[0].T + to_mm[1], triangles)
        if abs(smooth.volume / (count * image.voxel) - 1.0) < _MISSED:
            return smooth
    raise InputError(
        f"{name}: no smooth surface of one piece encloses its {count} voxels: parts are thinner "
        f"than the blur, {np.round((sigma * image.spacing).max(), 3)} mm; give less, --blur"
    )


def _contour(field: np.ndarray, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Return points (n, 3) and triangles (t, 3) of the largest piece of ``field = level``."""
    points, triangles, *_ = marching_cubes(field, level)
    piece = parts(triangles, len(points))[triangles[:, 0]]
    triangles = triangles[piece == np.argmax(np.bincount(piece))]
    return points.astype(float), triangles


def _enclosed(points: np.ndarray, triangles: np.ndarray) -> float:
    """Return the volume within a closed surface, in voxels."""
    a, b, c = np.moveaxis(points[triangles] - points.mean(axis=0), 1, 0)
    return float(abs(np.einsum("ti,ti->", a, np.cross(b, c))) / 6.0)


def left_ventricle(
    image: LabelImage,
    blood: Sequence[int],
    myocardium: Sequence[int],
    blur: float | None = None,
) -> VentricleSurfaces:
    """Return closed surfaces of a left ventricle, its long axis and its base plane.

    Parameters
    ----------
    image : the label image.
    blood, myocardium : the labels of the cavity, papillary muscles with it, and of the wall.
    blur : as of :func:`label_surface`.

    Raises
    ------
    InputError
        What :func:`label_surface` refuses, one label for both, or blood that myocardium encloses.
    """
    if set(blood) & set(myocardium):
        raise InputError(f"--blood {min(blood)} is a label of --myocardium, too; expected another")
    cavity, notes = largest_piece(image, blood, "blood")
    wall = image.mask(myocardium)
    whole, more = largest_piece(image, [*blood, *myocardium], "blood and myocardium")
    if not ((wall & whole).any() and (cavity & whole).any()):
        raise InputError(f"{image.name}: no voxel of the myocardium touches the blood")
    inner = mask_surface(image, cavity, "endocardium", blur)
    outer = mask_surface(image, whole | cavity, "epicardium", blur)
    axis, base, last = _base_plane(image, cavity, whole | cavity, blur)
    return VentricleSurfaces(inner, outer, axis, base, (*image.notes, *notes, *more, *last))


def _base_plane(
    image: LabelImage, cavity: np.ndarray, whole: np.ndarray, blur: float | None
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Return the axis (3,), a point (3,) mm of the base plane, and notes.

    The plane is half a voxel and two standard deviations below the lowest open face of the blood,
    where the blurred surfaces of blood and epicardium no longer meet.
    """
    padded = np.pad(whole, 1)
    inner = (slice(1, -1),) * 3
    faces = [
        (k, sign, cavity & ~np.roll(padded, -sign, axis=k)[inner])
        for k in range(3)
        for sign in (1, -1)
    ]
    pieces, count = label(np.any([is_open for *_, is_open in faces], axis=0), np.ones((3, 3, 3)))
    if not count:
        raise InputError(
            f"{image.name}: the myocardium is all around the blood; expected an open base"
        )
    sizes = np.bincount(pieces.ravel())[1:]
    largest = pieces == 1 + np.argmax(sizes)
    normal, places = np.zeros(3), []
    for k, sign, is_open in faces:
        voxels = np.argwhere(is_open & largest)
        normal[k] += sign * len(voxels)
        places.append(voxels + 0.5 * sign * np.eye(3)[k])
    edges = image.affine[:3, :3]
    if not normal.any():
        raise InputError(f"{image.name}: the blood has no opening in the myocardium to be a base")
    areas = np.cross(np.roll(edges, -1, axis=1), np.roll(edges, -2, axis=1), axis=0)
    axis = np.sign(np.linalg.det(edges)) * areas @ normal  # outward whatever the affine's sign
    axis /= np.linalg.norm(axis)
    points = np.concatenate(places) @ edges.T + image.affine[:3, 3]
    sigma = _BLUR * np.cbrt(image.voxel) if blur is None else blur
    below = 2.0 * sigma + 0.5 * np.abs(axis @ edges).max()
    middle = points.mean(axis=0)
    notes = []
    if count > 1:
        elsewhere = np.argwhere((pieces > 0) & ~largest)
        place = edges @ elsewhere[0] + image.affine[:3, 3]
        notes.append(
            f"the myocardium has holes besides the base: {len(elsewhere)} voxels of blood are at "
            f"its outside, such as at {place_of(place)} mm"
        )
    return axis, middle + ((points @ axis).min() - below - middle @ axis) * axis, notes
