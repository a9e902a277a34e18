"""A ventricle that relaxes, filled quickly and slowly: volumes and their derivatives."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

import calibrate as cal
import emulator as em

PRESSURE = 1.2  # kPa
RATES = {"fast": 0.2, "slow": 4.0}  # s until the pressure is there
HELD = (0.25, 1.0, 2.5)  # s after that, at which the volume is seen, too
ELASTIC = em.scenes.left_ventricle(rings=4, around=8, layers=1, order=1)
KNOWN = ("b", "b_f")  # at the middle of their ranges
BODY = replace(
    ELASTIC,
    constants={
        **ELASTIC.constants,
        **{n: float(v) for n, v in ELASTIC.resolve(ELASTIC.centre).items() if n in KNOWN},
    },
    parameters=(
        *(
            replace(p, low=1e-3 * p.low, high=1e3 * p.high)
            for p in ELASTIC.parameters
            if p.name not in KNOWN
        ),
        em.Parameter("relaxation_1", "", 0.001, 0.999),
        em.Parameter("tau_1", "s", 1e-3, 1e3, "log"),
        em.Parameter("time", "s", 0.0, 100.0),
    ),
    viscosity={"kind": "prony"},
)
OF_TISSUE = tuple(name for name in BODY.parameter_names if name not in BODY.load_parameters)
SIMULATOR = em.Simulator(BODY)
VOLUME = cal.CavityVolume(BODY)


def path(rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Pressures in kPa and times in s of one filling, and of what is held after it."""
    times = np.append(np.linspace(0.2, 1.0, 5) * rate, rate + np.array(HELD))
    return PRESSURE * np.minimum(times / rate, 1.0), times


def filled(tissue: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Volumes in mL at half the pressure, at all of it, and held; statuses of the steps."""
    values = dict(zip(OF_TISSUE, tissue, strict=True))
    volumes, statuses = [], []
    for rate in RATES.values():
        every = [{**values, "pressure": p, "time": t} for p, t in zip(*path(rate), strict=True)]
        thetas = jnp.array([[at[name] for name in BODY.parameter_names] for at in every])
        solution = SIMULATOR.path(thetas)
        seen = jax.vmap(VOLUME)(solution.displacement[:, VOLUME.nodes], thetas)
        volumes.append(seen[2:])
        statuses.append(solution.status)
    return jnp.concatenate(volumes), jnp.concatenate(statuses)


by_tissue = jax.jit(jax.jacfwd(filled, has_aux=True))


def solve(**values: float) -> tuple[dict[str, list[float]], dict[str, dict[str, list[float]]]]:
    """The outputs and their derivatives, as an external problem wants them."""
    tissue = jnp.array([values[name] for name in OF_TISSUE])
    volumes, statuses = filled(tissue)
    if np.asarray(statuses).any():
        raise ValueError("a step has no equilibrium")
    slopes = by_tissue(tissue)[0]
    slopes_by_name = {n: slopes[:, k].tolist() for k, n in enumerate(OF_TISSUE)}
    return {"volume": volumes.tolist()}, {"volume": slopes_by_name}
