"""Inferred noise beside the scatter of the data: the misfit of a law looks like noise."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from calibrate.statistical_model import Data, Model
from calibrate.statistical_model.predictive import noise_sds

LARGEST_SHARE = 0.05  # of the signal, above which inferred noise is no longer a measurement's
_OVER_SCATTER = 2.0  # inferred sd over the scatter of neighbouring data, above which it is misfit
_OVER_PRIOR = 2.0  # inferred sd over the scale of its prior
_EXACT = 1e-5  # of the signal, below which the noise is that of a computer's digits


@dataclass(frozen=True)
class TakenUp:
    """The inferred noise of one observation.

    name : the observation. unit : of the next four.
    sd : the median sd of a number of the data.
    signal : the largest distance of a measured value from its value at rest.
    scatter : the sd that differences between neighbouring residuals suggest: of what is not
        systematic, and would be seen again if the measurement were repeated.
    prior : the scale of the sd's prior.
    """

    name: str
    unit: str
    sd: float
    signal: float
    scatter: float
    prior: float

    @property
    def is_misfit(self) -> bool:
        """True where the noise is large and exceeds the scatter of neighbouring data."""
        large = self.sd > LARGEST_SHARE * self.signal or self.sd > _OVER_PRIOR * self.prior
        return large and self.sd > _OVER_SCATTER * self.scatter

    @property
    def remedy(self) -> str:
        """The remedy for noise that is a misfit, or too small for a measurement's; else empty."""
        if self.is_misfit:
            return (
                "the law misses the data by more than they scatter, and posterior sds say nothing "
                "of that; try another law (calibrate compare), or fewer tests at once"
            )
        if self.sd < _EXACT * self.signal:
            return (
                "no measurement is that exact, and no forward map; give the noise of the test that "
                f"the data stand for (--noise {self.name}=SD)"
            )
        return ""

    def __str__(self) -> str:
        """Return the noise as a share of the signal, and the scatter."""
        unit = "" if self.unit == "1" else f" {self.unit}"
        return (
            f"inferred noise of {self.name} is {self.sd:.2g}{unit}, "
            f"{100.0 * self.sd / self.signal:.2g} % of the largest ({self.signal:.3g}{unit}); "
            f"neighbouring data scatter by {self.scatter:.2g}{unit}"
        )


def taken_up(model: Model, data: Data, draws: Mapping[str, np.ndarray]) -> Iterator[TakenUp]:
    """Yield the inferred noise of every observation that has one.

    data : the data by the observation's name. draws : the draws (s,) by name.
    """
    inferred = [name for name, sites in model.noise_sites.items() if sites]
    if not inferred:
        return
    middle = {name: jnp.median(values) for name, values in draws.items()}
    means, sds = model.predict(middle)[0], noise_sds(model, draws)
    for name in inferred:
        part, y = model.observe.parts[name], np.asarray(data[name], dtype=float)
        residual = (y - np.asarray(means[name])).reshape(len(y) if y.ndim else 1, -1)
        signal = float(np.max(np.abs(y - getattr(part, "at_rest", 0.0)), initial=0.0))
        if signal > 0.0 and residual.size > 1:
            steps = np.diff(residual, axis=0 if len(residual) > 1 else 1)
            scatter = float(np.sqrt(np.mean(steps**2) / 2.0))
            prior = model.noise[name].upper_sd / model.noise[name].inferred(1.0).upper_sd
            yield TakenUp(name, part.unit, sds[name], signal, scatter, prior)


def sentences(noises: Iterator[TakenUp] | list[TakenUp]) -> list[str]:
    """Return a sentence with a remedy for each noise that cannot be a measurement's."""
    return [f"{noise}: {noise.remedy}" for noise in noises if noise.remedy]
