r"""Displacements of many points over many frames, as image correlation gives them.

A camera sees the plane: of each point two components, and not in every frame. Each frame is a load
state whose amount, the motion of what pulls the body, was measured with it. The points lie on one
surface of the body, so their place across the plane follows from theirs in it, and what is observed
is ``landmarks`` (:mod:`calibrate.measurements.displacements`) whose third component is missing.

Tables are read in three forms: a CSV file of points (``point,x,y``) and one of displacements
(``frame,point,ux,uy``); an ``.npz`` with ``points`` (n, 2), ``displacement`` (frames, n, 2) and
``frames``; or a folder of the text matrices ``x.txt``, ``y.txt``, ``ux.txt`` and ``uy.txt``, a row
a point and a column a frame. Lengths are in mm.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from calibrate.measurements.collection import Observations, observations
from calibrate.measurements.displacements import Landmarks
from calibrate.state_names import in_state
from emulator.core.cells import Cells, read_cells
from emulator.core.errors import InputError, look_up
from emulator.scenes.scene import Scene
from emulator.specimens.states import falls

_FOLLOWS = (
    0.9  # correlation of the points' mean motion with what pulls them, where frames are right
)
_ONE_PLACE = 1e-3  # of the usual distance: points nearer to each other are one
_FARTHER = 3.0  # times what pulls the body: its points do not move more
_AGAINST = -0.1  # of the pull: the points' mean motion does not go against it
_ASIDE = 0.2  # of the strain along a pull: a body does not grow more across it
_ZIGZAG = 0.04  # of the range of forces: a value differs less from its neighbours' mean
_TURNED = (
    "amounts of {}, below 0, are taken as pulls counted the other way round; give '{}' a range "
    "below 0 if they compress"
)
_MATRICES = ("x", "y", "ux", "uy")


@dataclass(frozen=True)
class FullField:
    """Displacements of points over frames.

    points : the places of the points before they move, (n, 2) mm.
    displacement : the displacements, (S, n, 2) mm; NaN where a point is not seen.
    frames : the names of the frames, (S,).
    """

    points: np.ndarray
    displacement: np.ndarray
    frames: tuple[str, ...]

    def __post_init__(self) -> None:
        shape = (len(self.frames), len(self.points), 2)
        if self.points.shape != shape[1:] or self.displacement.shape != shape:
            raise InputError(
                f"full field: points have shape {self.points.shape}, displacements "
                f"{self.displacement.shape}, and there are {len(self.frames)} frames; expected "
                "(n, 2) and (frames, n, 2)"
            )
        if not np.isfinite(self.points).all() or np.isinf(self.displacement).any():
            raise InputError("full field: a place is not finite, or a displacement is infinite")
        if len(self.points) > 1:
            ways, others = cKDTree(self.points).query(self.points, k=2)
            row = int(np.argmin(ways[:, 1]))
            # If every point is there twice, the median is the distance of the two.
            spread = float(np.ptp(self.points, axis=0).max()) / len(self.points)
            usual = max(float(np.median(ways[:, 1])), spread)
            if ways[row, 1] < _ONE_PLACE * usual:
                raise InputError(
                    f"full field: points {row + 1} and {others[row, 1] + 1} are "
                    f"{ways[row, 1]:.2g} mm apart, of {usual:.2g} usually: one place counts once"
                )

    def only(self, frames: Sequence[str], points: np.ndarray | None = None) -> FullField:
        """Return the field of some frames, in this order, and of the points with these numbers.

        :class:`InputError` for a frame that is not there.
        """
        for frame in frames:
            if frame not in self.frames:
                raise InputError(
                    f"full field: there is no frame '{frame}'; there are {self.frames[0]} to "
                    f"{self.frames[-1]}"
                )
        rows = [self.frames.index(frame) for frame in frames]
        kept = slice(None) if points is None else points
        return FullField(self.points[kept], self.displacement[rows][:, kept], tuple(frames))


def read_full_field(points: str | Path, displacements: str | Path | None = None) -> FullField:
    """Return the full field of a CSV file of points and one of displacements, or of one source.

    Parameters
    ----------
    points : a CSV file ``point,x,y``; or alone an ``.npz`` file, or a folder of text matrices.
    displacements : a CSV file ``frame,point,ux,uy``; rows may be missing.

    Raises
    ------
    InputError
        A file that is not there or not readable, a column or matrix that is missing, a point that
        the points' file does not have or that is twice in one frame.
    """
    source = Path(points)
    if not source.exists():
        raise InputError(f"full field: {source} does not exist")
    if displacements is not None:
        return _of_tables(source, Path(displacements))
    if source.is_dir():
        return _of_matrices(source)
    if source.suffix != ".npz":
        raise InputError(f"full field: {source} has points; name the file of displacements, too")
    try:
        with np.load(source, allow_pickle=False) as file:
            arrays = {name: np.asarray(file[name]) for name in file.files}
    except (OSError, ValueError) as error:
        raise InputError(f"full field: {source} is not a readable .npz file") from error
    for name in ("points", "displacement", "frames"):
        if name not in arrays:
            raise InputError(f"full field: {source} has no array '{name}'")
    frames = tuple(str(frame) for frame in arrays["frames"].tolist())
    return FullField(arrays["points"].astype(float), arrays["displacement"].astype(float), frames)


def _of_tables(points: Path, displacements: Path) -> FullField:
    places, table = (
        _cells(points, ("point", "x", "y")),
        _cells(displacements, ("frame", "point", "ux", "uy")),
    )
    rows, number = {}, 0
    for row, cell in places.rows.items():
        if cell["point"] in rows:
            raise InputError(f"data file {points}: row {row}, point '{cell['point']}' is twice")
        rows[cell["point"]], number = number, number + 1
    X = np.array([[places.number(row, word) for word in ("x", "y")] for row in places.rows])
    frames = tuple(dict.fromkeys(cell["frame"] for cell in table.rows.values()))
    index = {frame: k for k, frame in enumerate(frames)}
    u = np.full((len(frames), len(X), 2), np.nan)
    seen = np.zeros(u.shape[:2], bool)
    for row, cell in table.rows.items():
        if cell["point"] not in rows:
            raise InputError(
                f"data file {displacements}: row {row}, point '{cell['point']}' is not in {points}"
            )
        at = index[cell["frame"]], rows[cell["point"]]
        if seen[at]:
            raise InputError(
                f"data file {displacements}: row {row}, point '{cell['point']}' is twice in frame "
                f"'{cell['frame']}'"
            )
        u[at], seen[at] = [table.number(row, word, gaps=True) for word in ("ux", "uy")], True
    return FullField(X, u, frames)


def _of_matrices(folder: Path) -> FullField:
    arrays = {}
    for name in _MATRICES:
        path = folder / f"{name}.txt"
        if not path.is_file():
            raise InputError(f"full field: {path} does not exist; a folder has x, y, ux and uy.txt")
        try:
            arrays[name] = np.loadtxt(path, ndmin=2)
        except ValueError as error:
            raise InputError(f"full field: {path} is no matrix of numbers") from error
    if arrays["ux"].shape != arrays["uy"].shape:
        raise InputError(
            f"full field: {folder} has ux of shape {arrays['ux'].shape} and uy of "
            f"{arrays['uy'].shape}; expected the same, a row a point and a column a frame"
        )
    u = np.stack([arrays["ux"].T, arrays["uy"].T], axis=-1)
    points = np.column_stack([arrays["x"][:, 0], arrays["y"][:, 0]])
    return FullField(points, u, tuple(str(k) for k in range(len(u))))


def _cells(path: Path, words: Sequence[str]) -> Cells:
    if not path.is_file():
        raise InputError(f"data file {path} does not exist")
    cells = read_cells(path)
    for word in words:
        if word not in cells.words:
            raise InputError(
                f"data file {path}: column '{word}' is missing; expected {','.join(words)}"
            )
    return cells


def read_amounts(path: str | Path, column: str) -> dict[str, float]:
    """Return the number in ``column`` of each frame, from a CSV file with a column ``frame``."""
    cells = _cells(Path(path), ("frame", column))
    amounts: dict[str, float] = {}
    for row, cell in cells.rows.items():
        if cell["frame"] in amounts:
            raise InputError(
                f"data file {path}: row {row} is of frame '{cell['frame']}', and so is one before; "
                "give each frame one row"
            )
        amounts[cell["frame"]] = cells.number(row, column)
    return amounts


def sign_of(scene: Scene, parameter: str, amounts: Mapping[str, float]) -> float:
    """Return -1 where a pull is recorded as negative and the scene's parameter cannot be, else 1.

    ``amounts`` keep their signs otherwise: compression is no tension.
    """
    ranges = {p.name: p for p in scene.parameters}
    values = np.array(list(amounts.values()))
    negative = bool((values <= 0.0).all() and (values < 0.0).any())
    limits = ranges.get(parameter)
    return -1.0 if negative and limits is not None and limits.low >= 0.0 else 1.0


def _check_range(
    scene: Scene, parameter: str, amounts: Mapping[str, float], path: str | Path
) -> None:
    """Raise InputError if the scene's parameter cannot have an amount of a frame."""
    limits = look_up({p.name: p for p in scene.parameters}, parameter, "--amount: parameter")
    outside = [f for f, value in amounts.items() if not limits.low <= value <= limits.high]
    if outside:
        raise InputError(
            f"data file {path}: {len(outside)} of {len(amounts)} amounts, frame '{outside[0]}' at "
            f"{amounts[outside[0]]:.4g}, are outside of the scene's range of '{parameter}', "
            f"{limits.low:g} to {limits.high:g}: is the unit the scene's? else widen the range"
        )


def _side(amounts: Sequence[float] | np.ndarray) -> int:
    """Return the side of zero on which all amounts are, 0 where they are on both."""
    low, high = np.min(amounts), np.max(amounts)
    return int(low >= 0.0) - int(high <= 0.0)


def _zigzag(path: str | Path, values: np.ndarray) -> Iterator[str]:
    """Yield a question where the values (k,) of a rising curve go up and down between neighbours.

    A value differs little from the mean of its neighbours, unless the two branches of a cycle were
    sorted into one.
    """
    size = float(np.ptp(values)) if len(values) > 4 else 0.0
    if size > 0.0:
        gap = float(np.median(np.abs(values[1:-1] - 0.5 * (values[:-2] + values[2:])))) / size
        if gap > _ZIGZAG:
            yield (
                f"{path}: a force and its neighbours differ by {100 * gap:.0f} % of the range: are "
                "loading and unloading sorted into one curve? give the rows of loading alone"
            )


def read_curve(
    path: str | Path, amount: str, value: str, like: Sequence[float] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """Return amounts (k,) that rise, and values (k,), from two columns of a CSV file.

    like : amounts of frames. A sensor may count the other way round than they do, so a curve that
        lies wholly on the other side of zero changes its sign.

    :class:`InputError` for a curve whose amounts go back, as those of a cycle do.
    """
    cells = _cells(Path(path), (amount, value))
    pairs = np.array([[cells.number(row, word) for word in (amount, value)] for row in cells.rows])
    if len(like) and _side(pairs[:, 0]) * _side(like) < 0:
        pairs[:, 0] = 0.0 - pairs[:, 0]
    rising = pairs[:, 0] if pairs[-1, 0] >= pairs[0, 0] else -pairs[:, 0]
    back = np.flatnonzero(falls(rising - rising.min()))
    if len(back):
        raise InputError(
            f"data file {path}: column '{amount}' goes back at row {back[0] + 1}: a curve of "
            "loading and unloading has two forces at one amount; give the rows of loading alone"
        )
    order = np.argsort(pairs[:, 0], kind="stable")
    return pairs[order, 0], pairs[order, 1]


def spread_points(points: np.ndarray, count: int) -> np.ndarray:
    """Return the numbers (count,) of points (n, ...), each the farthest from those before it.

    :class:`InputError` where there are fewer.
    """
    if not 1 <= count <= len(points):
        raise InputError(f"{count} points; there are {len(points)}")
    chosen = [0]
    ways = np.linalg.norm(points - points[0], axis=1)
    for _ in range(count - 1):
        chosen.append(int(np.argmax(ways)))
        ways = np.minimum(ways, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen)


def measured_field(
    scene: Scene,
    files: Sequence[str | Path],
    amount: Sequence[str],
    forces: Sequence[Sequence[str]] = (),
    *,
    frames: Sequence[str] | None = None,
    points: int = 60,
) -> tuple[Observations, dict[str, np.ndarray], dict[str, float], list[str]]:
    """Return the observations of a full field and of forces beside it, data, amounts, and doubts.

    Amounts are those of the parameter that pulls the body, by ``parameter@frame``; a doubt is a
    sentence on what contradicts itself.

    Parameters
    ----------
    scene : as of :func:`field_data`.
    files : the arguments of :func:`read_full_field`.
    amount : the parameter that pulls the body, and the file and the column of its amounts.
    forces : of each force, the observation, such as ``reaction:pad:x``, a file, and its columns of
        the amount and of the force in N.
    frames : the frames that are data; by default all in which the body is pulled.
    points : the largest number of points, spread as far from each other as they go.

    Raises
    ------
    InputError
        What the functions of this file refuse, a force that is there twice, or a frame at which it
        was not measured.
    """
    from calibrate.measurements import parse_observation

    (parameter, path, column), field = amount, read_full_field(*files)
    amounts, source = read_amounts(path, column), path
    sign = sign_of(scene, parameter, amounts)
    amounts = {frame: sign * value for frame, value in amounts.items()}
    pulled = [frame for frame in field.frames if amounts.get(frame) != 0.0]
    chosen = spread_points(field.points, min(points, len(field.points)))
    field = field.only(frames or pulled, chosen)
    observe, data = field_data(scene, field, amounts)
    _check_range(scene, parameter, {frame: amounts[frame] for frame in field.frames}, source)
    parts, beside = dict(observe.parts), list[str]()
    for word, path, pull, force in forces:
        at, forces_at = read_curve(path, pull, force, list(amounts.values()))
        beside += [*_zigzag(path, forces_at)]
        ((name, part),) = parse_observation(scene, word, 0).parts.items()
        if in_state(name, field.frames[0]) in parts:
            raise InputError(f"force: {word} is given twice; give one curve for each")
        for frame in field.frames:
            if not at[0] <= amounts[frame] <= at[-1]:
                raise InputError(
                    f"force: {path} goes from {at[0]:.4g} to {at[-1]:.4g}, frame '{frame}' is at "
                    f"{amounts[frame]:.4g}"
                )
            parts[in_state(name, frame)] = part
            data[in_state(name, frame)] = np.array(np.interp(amounts[frame], at, forces_at))
    known = {in_state(parameter, frame): amounts[frame] for frame in field.frames}
    doubts = [_TURNED.format(source, parameter)] if sign < 0.0 else []
    doubts += [*field_doubts(scene, field, amounts, parameter), *beside]
    return observations(parts), data, known, doubts


def field_data(
    scene: Scene, field: FullField, amounts: Mapping[str, float], facet_set: str = "top"
) -> tuple[Observations, dict[str, np.ndarray]]:
    """Return the observations of a full field, ``displacement@frame``, and their data.

    Parameters
    ----------
    scene : the scene of the body, the points' plane being its plane of x and y.
    field : the points in the scene's frame, and their displacements from the shape of its mesh.
    amounts : what pulls the body, by frame: as ``displacement`` in mm, so that its order can be
        compared with that of the frames.
    facet_set : the facets on which the points lie, at one z.

    Raises
    ------
    InputError
        A facet set that is not flat, a point outside, a frame without an amount, or displacements
        that do not follow the amounts.
    """
    try:
        z = scene.mesh.nodes[np.unique(scene.mesh.facet_set(facet_set))][:, 2]
    except InputError as error:
        raise InputError(
            f"{error}: a full field lies on that flat side of the body, which says its z; name "
            f"the side that the camera sees '{facet_set}'"
        ) from error
    if np.ptp(z) > 1e-6 * scene.mesh.size:
        raise InputError(f"facet set '{facet_set}' is not at one z; a full field is of a plane")
    for frame in field.frames:
        if frame not in amounts:
            raise InputError(f"full field: frame '{frame}' has no amount; give one for each")
    _check_order(field, np.array([amounts[frame] for frame in field.frames]))
    part = Landmarks.of(scene, np.column_stack([field.points, np.full(len(field.points), z[0])]))
    data = {
        in_state("displacement", frame): np.column_stack([u, np.full(len(u), np.nan)])
        for frame, u in zip(field.frames, field.displacement, strict=True)
    }
    return observations(dict.fromkeys(data, part)), data


def field_doubts(
    scene: Scene, field: FullField, amounts: Mapping[str, float], parameter: str
) -> Iterator[str]:
    """Yield a sentence for each doubt about a full field beside the supports that pull the body.

    parameter : what the ``amounts`` are of.
    """
    pulls = scene.prescribed.per_unit.get(parameter, np.zeros((1, 3)))[:, :2]
    last = int(np.argmax([abs(amounts[frame]) for frame in field.frames]))
    amount, u = amounts[field.frames[last]], field.displacement[last]
    seen = np.isfinite(u).all(axis=1)
    if not pulls.any() or amount == 0.0 or seen.sum() < 4:
        return
    most = abs(amount) * np.linalg.norm(pulls, axis=1).max()
    far = float(np.quantile(np.linalg.norm(u[seen], axis=1), 0.95))
    if far > _FARTHER * most:
        yield (
            f"points of frame '{field.frames[last]}' move by {far:.3g}, what pulls them by "
            f"{most:.3g} mm: are displacements in pixels? multiply by a pixel's size in mm"
        )
    for k, axis in enumerate("xy"):
        pull = pulls[:, k].sum()
        if pull and (pulls[:, k] * pull >= 0.0).all():
            share = u[seen, k].mean() / (amount * np.abs(pulls[:, k]).max() * np.sign(pull))
            if share < _AGAINST:
                yield (
                    f"points of frame '{field.frames[last]}' move against the pull along {axis}: "
                    f"does {axis} of the image point the other way (rows count down)?"
                )
    if (along := np.flatnonzero(pulls.any(axis=0))).size == 1:
        x = field.points[seen] - field.points[seen].mean(axis=0)
        gradient = np.linalg.pinv(x) @ (u[seen] - u[seen].mean(axis=0))
        stretch, aside = gradient[along[0], along[0]], gradient[1 - along[0], 1 - along[0]]
        if stretch > 0.0 and aside > _ASIDE * stretch:
            yield (
                f"points of frame '{field.frames[last]}' part by {100 * aside:.2g} % across the "
                f"pull, by {100 * stretch:.2g} % along it: does {'yx'[along[0]]} of the image "
                "point the other way (rows count down)?"
            )


def _check_order(field: FullField, amounts: np.ndarray) -> None:
    """Raise :class:`InputError` if the points' motion does not correlate with the amounts."""
    if len(amounts) < 4 or np.ptp(amounts) == 0.0:
        return
    motion = np.nanmean(np.linalg.norm(field.displacement, axis=2), axis=1)
    following = float(np.corrcoef(motion, np.abs(amounts))[0, 1])
    if not following > _FOLLOWS:
        raise InputError(
            f"full field: the points' motion over {len(amounts)} frames correlates with the "
            f"amounts by {following:.2f} only; are the frames in the order of the amounts?"
        )
