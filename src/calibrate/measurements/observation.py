"""What an observation is: measured numbers as a function of displacement and of theta.

A kind of observation declares constants (its name, words, unit and columns), makes itself from a
scene (``of``) and predicts its numbers (``evaluate``). Command-line words, JSON, shape, labels,
missing values and columns of data files follow from the declaration: of a single number here, of
numbers at places in :mod:`calibrate.measurements.points`. A new kind is a file beside this one and
a line in :data:`calibrate.measurements.OBSERVATIONS`.

Leaving a missing entry out is exact. With entries m missing and p present, the likelihood of what
was measured is the integral of p(y_p, y_m | theta) over y_m, which for independent noise drops the
factors of y_m, and for correlated Gaussian noise the rows and columns of its covariance. This
supposes that whether a value is missing does not depend on the value.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from copy import copy
from typing import Any, ClassVar, NamedTuple, Self

import jax
import numpy as np
from scipy.sparse import csr_array

from calibrate.noise.gaussian import GaussianNoise
from calibrate.noise.protocol import Sites
from emulator.core.errors import InputError
from emulator.scenes.scene import Scene
from emulator.surrogates.protocol import ForwardMap

LARGEST_SHARE = 0.03
"""Largest default sd of noise as a share of the body's size, or of the cavity's volume."""

LENGTH_UNITS: Mapping[str, float] = {"m": 1e3, "cm": 10.0, "µm": 1e-3}
"""Units that lengths in mm may come in by mistake, each in mm."""


class Field(NamedTuple):
    """One array of a data file.

    variable : its name in netCDF.
    columns : its columns in CSV; an array of one column has shape (rows,), of k columns (rows, k).
    where : whether it says where was measured, not what. What was measured may be missing.
    """

    variable: str
    columns: tuple[str, ...]
    where: bool = False

    def named(self, *words: object) -> Field:
        """Return the field with ``words`` in place of ``{}`` in its names."""
        columns = tuple(column.format(*words) for column in self.columns)
        return Field(self.variable.format(*words), columns, self.where)


class Table(NamedTuple):
    """The arrays of a data file that hold one observation.

    arguments : the arguments of ``of`` that the columns' names contain, such as a facet set.
    fields : the arrays; where was measured comes first.
    """

    arguments: tuple[Any, ...]
    fields: tuple[Field, ...]


Block = Sequence[tuple[Field, np.ndarray]]
"""The fields of one observation with their arrays."""


Labels = tuple[dict[str, np.ndarray], dict[str, list[str]], dict[str, Any]]
"""How data is labelled in the DataTree: arrays that go with it, such as reference positions; the
dimensions of each array, by the array's name; the values of each dimension."""


class Observation(ABC):
    """Measured numbers as a function of the displacement of a few nodes, and of theta.

    This class is an observation of one number; its column is called as on the command line,
    ``kind:argument:argument``. A kind is a frozen dataclass that declares

    kind : its name in the registry, in JSON and on the command line.
    usage : the words that ask for it, for help and errors.
    hint : the text that an error adds to the usage.
    arguments : the names of the arguments of ``of`` after the scene, which are text and attributes
        of the observation, too.
    quantity : the measured quantity, such as ``displacement``.
    unit : the unit of the data; ``1`` where it has none.
    other_units : units the data may be in by mistake, each with the factor that converts it.
    usual_sd : the standard deviation of the noise where none is given; None if it must be given.
    positive : whether the number must be above 0.
    nodes : the nodes whose displacement it needs, (k,).

    and has ``entries`` (n,), the positions in the raveled data that are not missing, ascending;
    None where nothing is missing.
    """

    kind: ClassVar[str]
    usage: ClassVar[str]
    hint: ClassVar[str] = ""
    arguments: ClassVar[tuple[str, ...]]
    quantity: ClassVar[str]
    usual_sd: ClassVar[float | None] = None
    positive: ClassVar[bool] = True
    unit: str
    other_units: Mapping[str, float] = {}
    nodes: np.ndarray
    entries: np.ndarray | None = None

    @abstractmethod
    def evaluate(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the data without noise and without gaps, (..., *shape), in one load state.

        displacement : the displacement of ``nodes``, mm, (..., k, 3).
        theta : the parameters in the order of the scene's ``parameter_names``, (..., p).
        """

    @classmethod
    def of(cls, scene: Scene, *arguments: Any, **options: Any) -> Self:
        """Return the observation of ``scene`` that the arguments describe, as text or arrays."""
        return cls(scene, *arguments)  # type: ignore[call-arg]

    @property
    def names(self) -> tuple[str, ...]:
        """The observation's possible names in a data file; the first one where it is alone."""
        return (":".join([self.kind, *(str(getattr(self, a)) for a in self.arguments)]),)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the data; (n,) where entries are missing."""
        return ()

    @property
    def missing(self) -> int:
        """Number of entries left out."""
        return 0

    @property
    def sites(self) -> Sites | None:
        """The position of each number of the data; None for what has no one position."""
        return None

    @property
    def matrix(self) -> csr_array | None:
        """The matrix (e, 3 k) of data without gaps, (e,), by the displacement of the nodes, (3 k,).

        None where the data is no linear function of the displacement, or depends on theta.
        """
        return None

    def labels(self, name: str) -> Labels:
        """Return the labels of the data called ``name`` in the DataTree."""
        return {}, {}, {}

    @classmethod
    def parse(cls, scene: Scene, word: str, seed: int) -> tuple[str, Self]:
        """Return the name and the observation that ``word`` of the command line asks for.

        The word begins with the kind. Random places are drawn from ``seed``.
        """
        rest = word.partition(":")[2]
        texts = rest.split(":") if len(cls.arguments) > 1 else [rest]
        if (len(texts) > 1 and not all(texts)) or len(texts) != len(cls.arguments):
            raise cls.misuse(word)
        try:
            return word, cls.of(scene, *texts)
        except InputError:
            raise
        except ValueError:  # text that is no number
            raise cls.misuse(word) from None

    @classmethod
    def misuse(cls, word: str) -> InputError:
        """Return the error for a word of this kind that it cannot read."""
        return InputError(f"observe '{word}': give {cls.usage}{cls.hint}")

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON from which the registry makes the observation again."""
        return {"kind": self.kind, "word": self.names[-1]}

    @classmethod
    def from_json(cls, scene: Scene, description: Mapping[str, Any]) -> Self:
        """Return the observation that :meth:`to_json` described."""
        return cls.parse(scene, description["word"], 0)[1]

    @classmethod
    def tables(cls, words: Collection[str]) -> dict[str, Table]:
        """Return the tables of this kind's observations, by the observation's name.

        ``words`` are the columns or variables of a file; some that a table needs may be missing.
        """
        own = (word for word in words if word.partition(":")[0] == cls.kind)
        return {word: Table((), (Field(word, (word,)),)) for word in own}

    @classmethod
    def read(
        cls, scene: Scene, name: str, table: Table, arrays: Mapping[str, np.ndarray]
    ) -> tuple[Self, np.ndarray]:
        """Return the observation called ``name`` and its data, from the arrays of its table."""
        _, part = cls.parse(scene, name, 0)
        if arrays[name].size != 1:
            raise InputError(f"{name} has {arrays[name].size} values; give one, in {part.unit}")
        return part, arrays[name].reshape(())

    def block(self, name: str, values: np.ndarray) -> Block:
        """Return the arrays that hold ``values`` in a data file, NaN where they are missing."""
        return [(Field(name, (name,)), np.asarray(values))]

    def filled(self, values: np.ndarray) -> np.ndarray:
        """Return ``values`` (*shape) as data without gaps, NaN where missing."""
        return np.asarray(values)

    def check(self, name: str, values: np.ndarray) -> None:
        """Raise :class:`InputError` on data of a wrong shape or with impossible values.

        NaN marks a missing value and passes.
        """
        if values.shape != self.shape:
            gaps = f", as {self.missing} values are missing" if self.missing else ""
            raise InputError(
                f"data has shape {values.shape}; the observation expects {self.shape}{gaps} "
                f"({name}, {self.unit})"
            )
        self.check_values(name, self.filled(values))

    def check_values(self, name: str, values: np.ndarray) -> None:
        """Raise :class:`InputError` if a value of the data without gaps is impossible."""
        if np.isinf(values):
            raise InputError(f"data: {name} is {values}; it must be finite")
        if self.positive and values <= 0.0:
            raise InputError(f"data: {name} is {values} {self.unit}; it must be above 0")

    def restricted(self, entries: np.ndarray | None) -> Self:
        """Return the observation of ``entries`` alone, or of all for None."""
        part = copy(self)  # unlike `replace`, `copy` keeps what the observation has computed
        part._derive(entries=entries)
        return part

    def __call__(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the data without noise (..., *shape), from one load state; see ``evaluate``."""
        return self.evaluate(displacement, theta)

    def through(self, forward: ForwardMap) -> Callable[[jax.Array], jax.Array] | None:
        """Return the data without noise, (*shape), as a function of theta (p,), or None.

        It is not None where the map tells this observation better than its displacement does, which
        is only nearly in equilibrium.
        """
        return None

    @property
    def default_noise(self) -> GaussianNoise:
        """The noise of an observation that names none; :class:`InputError` if it must."""
        if self.usual_sd is None:
            name = self.names[0]
            raise InputError(f"{name} has no usual noise; give --noise {name}=SD, in {self.unit}")
        return GaussianNoise(sd=self.usual_sd)

    def size_in(self, scene: Scene) -> float | None:
        """Return the size of what is observed of the body at rest, in the data's unit, if any."""
        return scene.mesh.size if self.unit == "mm" else None

    def noise_in(self, scene: Scene) -> GaussianNoise:
        """Return :attr:`default_noise`, no larger than a share of what is observed in ``scene``."""
        noise, size = self.default_noise, self.size_in(scene)
        largest = np.inf if size is None else LARGEST_SHARE * size
        return noise if noise.upper_sd <= largest else GaussianNoise(sd=float(f"{largest:.2g}"))

    def _derive(self, **attributes: Any) -> None:
        """Set attributes that follow from the fields; for ``__post_init__``."""
        for name, value in attributes.items():
            object.__setattr__(self, name, value)


Scalar = Observation
"""The base class of a single number."""
