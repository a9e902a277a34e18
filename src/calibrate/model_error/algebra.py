r"""The algebra of errors of data: their terms are joined to one likelihood, or refused.

All terms are joined to two (:mod:`calibrate.model_error.marginal`), and the second is eliminated
beside the information that the first leaves. The first term has the modes of size 1 without shares
of the prediction, so that it leaves the same information for all unknowns. The second term has the
other modes, of one size. Modes are chosen for which G is diagonal, except where the second term has
shares: it is then eliminated anew for each prediction.

Three conditions follow. Noise must be Gaussian where terms are integrated out, its information must
not change with the unknowns, and at most one size may be unknown.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from calibrate.model_error.marginal import ModelError, Term, times
from calibrate.noise.protocol import Noise
from emulator.core.errors import InputError


def check_algebra(
    what: str,
    noise: Mapping[str, Noise],
    sizes: Collection[str] = (),
    *,
    gaussian: bool = True,
    known: bool = True,
) -> None:
    """Raise :class:`InputError` unless noise and errors have the properties that algebra needs.

    what : the beginning of the message.
    sizes : the different sizes that are not known, as of :attr:`Term.unknown_size`.
    gaussian, known : whether the noise has to be Gaussian, and its sd known.
    """
    for name, noise_model in noise.items():
        start = f"{what}: the noise of {name} must be"
        if gaussian and not noise_model.gaussian:
            raise InputError(f"{start} Gaussian; it is {noise_model.kind}")
        if known and noise_model.priors:
            raise InputError(
                f"{start} of known sd; {', '.join(noise_model.priors)} is inferred; give a number, "
                f"as in --noise {name}=SD"
            )
    if len(sizes) > 1:
        reasons = " and ".join(sorted(sizes))
        raise InputError(f"{what}: {reasons}; only one size can be unknown, by one name and scale")


def marginalised(terms: Sequence[Term], information: np.ndarray) -> ModelError:
    """Return ``terms`` together, integrated out; at most one of their sizes is not known.

    The declarations of terms that are integrated out already may be among them.

    information : information W of the noise about the data's means, (d, d), or its diagonal (d,).
    """
    if not terms:
        return ModelError()
    constant = [term for term in terms if term.size is None and term.shares is None]
    others = [term for term in terms if term.size is not None or term.shares is not None]
    first = _together(constant, information)
    if not others:
        return ModelError((first,))
    if all(term.shares is None for term in others):
        second = _together(others, information, first)
        return ModelError((first, replace(second, mixing=None)))
    left = information
    if constant:
        left = np.asarray(ModelError((first,)).information_left(jnp.asarray(left), 1.0, {}))
    sized = [
        np.full(len(t.modes), t.size is not None) if t.sized is None else t.sized for t in others
    ]
    together = Term(
        np.concatenate([term.modes for term in others]),
        np.concatenate([0.0 * t.modes if t.shares is None else t.shares for t in others]),
        next((term.size for term in others if term.size is not None), None),
        1.0 * np.concatenate(sized),
        information=left,
    )
    return ModelError((first, together))


def _together(terms: Sequence[Term], information: np.ndarray, before: Term | None = None) -> Term:
    """Return terms of one size without shares as one, its modes chosen such that G is diagonal.

    information : information W of the noise, of which ``before`` leaves a part.
    """
    modes = np.concatenate([np.zeros((0, len(information))), *(term.modes for term in terms)])
    weighted = times(modes, information)
    if before is not None:
        between = (weighted @ before.modes.T) / (1.0 + before.strength)
        weighted = weighted - between @ before.weights
    strength, mixing = np.linalg.eigh(weighted @ modes.T)
    visible = strength > 1e-12 * max(float(strength.max(initial=0.0)), 1e-300)
    rows = mixing[:, visible].T
    return replace(
        terms[0] if terms else Term(modes),
        modes=rows @ modes,
        weights=rows @ weighted,
        strength=strength[visible],
        mixing=rows,
        names=tuple(name for term in terms for name in term.names),
    )
