"""The samplers by name, behind one protocol. A new sampler is one file and one line here."""

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from shutil import disk_usage
from typing import Any

from calibrate.samplers.auto import AUTO, AutoOptions
from calibrate.samplers.chains import ChainSampler
from calibrate.samplers.importance import IMPORTANCE, ImportanceOptions
from calibrate.samplers.laplace import LAPLACE, LaplaceOptions
from calibrate.samplers.nuts import BLACKJAX_NUTS, NUTS, BlackJAXNUTSOptions, NUTSOptions
from calibrate.samplers.protocol import ChainOptions, Kernel, Sampler
from calibrate.samplers.smc import SMC, SMCOptions
from calibrate.statistical_model.density import Density, density_of
from emulator.core.errors import InputError, look_up
from emulator.core.machine import memory
from emulator.core.schema import Source, parse, table_of

_ALL: tuple[Sampler, ...] = (AUTO, IMPORTANCE, NUTS, BLACKJAX_NUTS, SMC, LAPLACE)
SAMPLERS: dict[str, Sampler] = {sampler.name: sampler for sampler in _ALL}

__all__ = [
    "SAMPLERS",
    "AutoOptions",
    "BlackJAXNUTSOptions",
    "ChainOptions",
    "ChainSampler",
    "Density",
    "ImportanceOptions",
    "Kernel",
    "LaplaceOptions",
    "NUTSOptions",
    "SMCOptions",
    "density_of",
]


def find_sampler(name: str | None, options: Any | None = None) -> Sampler:
    """Return the sampler of that name; by default that of the options, or ``auto``.

    Raises
    ------
    InputError
        An unknown name; the known ones are given.
    """
    if name is None:
        samplers = (sampler for sampler in _ALL if sampler.options is type(options))
        return next(samplers, AUTO)
    return look_up(SAMPLERS, name, "sampler")


def check_options(
    sampler: Sampler, options: Any | None, numbers: int, file: str | Path | None = None
) -> Any:
    """Return ``options``, or the sampler's defaults for ``None``.

    numbers : the float64 numbers that are kept of each draw.
    file : a file on the disk that the draws are written to.

    Raises
    ------
    InputError
        The options are those of another sampler, or ask for more draws than memory, or the disk,
        has room for.
    """
    options = sampler.options() if options is None else options
    if type(options) is not sampler.options:
        raise InputError(
            f"sampler '{sampler.name}' takes {sampler.options.__name__}, "
            f"not {type(options).__name__}"
        )
    count = options.draws * options.chains
    if (size := 8.0 * count * numbers) > memory():
        most = memory() / (8.0 * options.chains * numbers)
        raise InputError(
            f"{options.chains} x {options.draws} draws take {size / 1e9:.3g} GB, and there are "
            f"{memory() / 1e9:.3g}; give fewer than {most:.2g} draws"
        )
    if file is not None:
        folder = next(path for path in Path(file).absolute().parents if path.exists())
        if (free := disk_usage(folder).free) < size:
            raise InputError(
                f"{folder}: the draws take {size / 1e6:.3g} MB, and the disk has "
                f"{free / 1e6:.3g} free; make room, or name a folder on another disk"
            )
    return options


def options_from(sampler: Sampler, values: Mapping[str, Any], **length: int) -> Any:
    """Return options of a run of this length, with ``values`` by name for the others.

    length : ``warmup``, ``draws`` and ``chains``; what the sampler does not have is left out.

    Raises
    ------
    InputError
        A name that the sampler has no option of, or a value of another type.
    """
    source = Source(f"sampler '{sampler.name}'", dict(values), toml=False)
    parse(table_of(sampler.options), source)
    known = {field.name for field in fields(sampler.options)}
    return sampler.options(**{n: k for n, k in length.items() if n in known} | dict(values))
