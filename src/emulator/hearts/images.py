"""Label images of segmentations: NIfTI by nibabel, NRRD by pynrrd (extra ``images``).

Coordinates are millimetres in the right-anterior-superior (RAS) directions that NIfTI uses. NRRD
files in left-posterior-superior directions are converted, so that both files of one image give the
same surface. Voxel (i, j, k) has its middle at ``affine @ (i, j, k, 1)``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from emulator.core.errors import InputError
from emulator.core.units import IN_MM, MM3_PER_ML

NEEDED = "images need nibabel, pynrrd and scikit-image: pip install 'soft-tissue-calibrate[images]'"
"""The line that says which extra is lacking."""

try:
    import nibabel
    import nrrd
except ModuleNotFoundError as error:
    raise InputError(NEEDED) from error

_NIFTI, _NRRD = (".nii", ".nii.gz"), (".nrrd",)
_UNITS = {"mm": "mm", "meter": "m", "micron": "um", "unknown": "mm"}  # NIfTI's words
_TO_RAS = {"right": 1.0, "left": -1.0, "anterior": 1.0, "posterior": -1.0, "superior": 1.0}
_SHORT = {"R": "right", "L": "left", "A": "anterior", "P": "posterior", "S": "superior"}
_FLAT = 1e-6  # of the product of the voxel's edges: a smaller volume is a singular affine
_LISTED = 12  # labels in a message


@dataclass(frozen=True, eq=False)
class LabelImage:
    """An image whose voxels are whole numbers, 0 being the background.

    name : the name in messages. labels : (i, j, k). affine : (4, 4), from voxels to mm, RAS.
    notes : what is doubtful, a line each.
    """

    name: str
    labels: np.ndarray
    affine: np.ndarray
    notes: tuple[str, ...] = ()

    @property
    def spacing(self) -> np.ndarray:
        """Lengths (3,) of a voxel's edges, mm."""
        return np.linalg.norm(self.affine[:3, :3], axis=0)

    @property
    def voxel(self) -> float:
        """Volume of a voxel, mm3."""
        return float(abs(np.linalg.det(self.affine[:3, :3])))

    @cached_property
    def volumes(self) -> dict[int, float]:
        """Volume in mL of each label but the background, the largest first."""
        values, counts = np.unique(self.labels, return_counts=True)
        pairs = sorted(zip(counts.tolist(), values.tolist(), strict=True), reverse=True)
        return {int(v): n * self.voxel / MM3_PER_ML for n, v in pairs if v != 0}

    def listed(self) -> str:
        """Return the labels with their volumes, the largest first."""
        names = [f"{label} ({volume:.4g} mL)" for label, volume in self.volumes.items()]
        rest = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
        return ", ".join(names[:_LISTED]) + rest

    def mask(self, labels: Sequence[int]) -> np.ndarray:
        """Return whether each voxel has one of ``labels``; :class:`InputError` for unknown ones."""
        for label in labels:
            if label not in self.volumes:
                raise InputError(f"{self.name}: it has no label {label}; labels: {self.listed()}")
        return np.isin(self.labels, labels)


def read_labels(path: str | Path) -> LabelImage:
    """Return the label image of a NIfTI or NRRD file.

    :class:`InputError` for a file that cannot be read, an image with more than three axes or of
    numbers that are no labels, a singular affine, or nothing but background.
    """
    path = Path(path)
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "does not exist"
        raise InputError(f"image {path} {what}; expected a .nii, .nii.gz or .nrrd file")
    name = path.name.lower()
    if not name.endswith((*_NIFTI, *_NRRD)):
        raise InputError(f"image {path}: expected a .nii, .nii.gz or .nrrd file")
    try:
        values, affine, notes = (_read_nrrd if name.endswith(_NRRD) else _read_nifti)(path)
    except InputError:
        raise
    except Exception as error:  # the readers raise many types
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise InputError(f"image {path} cannot be read: {reason}") from error
    return label_image(str(path), values, affine, notes)


def label_image(
    name: str, values: np.ndarray, affine: np.ndarray, notes: Sequence[str] = ()
) -> LabelImage:
    """Return the label image of an array, checked.

    Parameters
    ----------
    name : the name of the image in messages.
    values : the labels, (i, j, k) or with further axes of length 1; floats must be whole numbers.
    affine : the map from voxels to mm, (4, 4).
    notes : what is doubtful about the file.

    Raises
    ------
    InputError
        What :func:`read_labels` refuses.
    """
    name = f"image {name}"
    if values.ndim > 3:
        values = values.reshape(values.shape[:3] + tuple(n for n in values.shape[3:] if n > 1))
    if values.ndim != 3:
        raise InputError(
            f"{name}: its shape is {values.shape}; expected three axes, one frame of the image"
        )
    if values.dtype.kind not in "iubf":
        raise InputError(f"{name}: its voxels are {values.dtype}; expected whole numbers")
    if values.dtype.kind == "f":
        odd = values[~(values == np.round(values))]
        if odd.size:
            raise InputError(
                f"{name}: {odd.size} voxels are no whole numbers, such as {odd[0]:.4g}; expected "
                "labels, not intensities or probabilities"
            )
        values = values.astype(np.int64)
    edges = affine[:3, :3]
    box = np.prod(np.linalg.norm(edges, axis=0))
    if not np.isfinite(affine).all() or not abs(np.linalg.det(edges)) > _FLAT * box:
        raise InputError(
            f"{name}: its affine {np.round(edges, 4).tolist()} is singular; expected three edges "
            "of a voxel that span a volume"
        )
    if not values.any():
        raise InputError(f"{name}: all of its voxels are 0; expected labels above the background")
    return LabelImage(name, values, np.asarray(affine, dtype=float), tuple(notes))


def _read_nifti(path: Path) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Return voxels, affine in mm and notes: nibabel takes the sform, else the qform."""
    file: Any = nibabel.load(path)
    unit = file.header.get_xyzt_units()[0]
    affine = np.diag([*[IN_MM[_UNITS[unit]]] * 3, 1.0]) @ file.affine
    notes = []
    if not file.header["sform_code"] and not file.header["qform_code"]:
        notes.append(
            f"image {path} has neither sform nor qform: coordinates are in its own axes, from the "
            "middle of the image"
        )
    return np.asanyarray(file.dataobj), affine, notes


def _read_nrrd(path: Path) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Return voxels, affine in mm, RAS where the file names its space, and notes."""
    values, header = nrrd.read(str(path), index_order="F")
    if values.ndim != 3:  # directions of further axes are none
        return values, np.eye(4), []
    affine, notes = np.eye(4), []
    if "space directions" in header:
        affine[:3, :3] = np.array(header["space directions"], dtype=float).T
        affine[:3, 3] = header.get("space origin", np.zeros(3))
    elif "spacings" in header:
        affine[:3, :3] = np.diag(np.array(header["spacings"], dtype=float))
        notes.append(f"image {path} has spacings alone: its middle of voxel 0 is the origin")
    else:
        raise InputError(
            f"image {path}: it has neither space directions nor spacings; expected the size of a "
            "voxel"
        )
    space = str(header.get("space", ""))
    words = [_SHORT.get(c, "") for c in space] if len(space) == 3 else space.lower().split("-")
    if len(words) == 3 and all(word in _TO_RAS for word in words):
        affine = np.diag([*(_TO_RAS[word] for word in words), 1.0]) @ affine
    else:
        notes.append(f"image {path} is in space '{space}': its coordinates are kept as they are")
    units = {str(unit).strip('"') for unit in header.get("space units", ["mm"])}
    if len(units) != 1 or not units <= IN_MM.keys():
        raise InputError(
            f"image {path}: its space units are {', '.join(sorted(units))}; expected one of "
            f"{', '.join(IN_MM)}"
        )
    return values, np.diag([*[IN_MM[units.pop()]] * 3, 1.0]) @ affine, notes
