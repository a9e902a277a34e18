"""Biaxial tests by pyMechT and by this package: stresses, and effective draws of one posterior.

    python -m studies.pymecht                 # needs the package pymecht; three minutes
    python -m studies.pymecht --quick --out DIR

Writes results.json and pymecht.png, and asserts what the README says.
"""

import contextlib
import io
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from studies.common.output import Case, Results, parser, run, save

import calibrate as cal
import emulator as em
from calibrate.figures import BLUE, ORANGE, pyplot
from emulator.core.errors import InputError

HERE = Path(__file__).parent
SEED = 5
ANGLE = 35.0  # degrees of two families of fibres from x
RATIOS = ((1.0, 1.0), (1.0, 0.5), (0.5, 1.0))  # of the strains along x and y
STRAINS = np.linspace(0.02, 0.2, 10)
SD = 2.0  # kPa
TRUTH = {"c": 20.0, "k_1": 30.0, "k_2": 8.0, "dispersion": 0.12}
RANGES = {"c": (1.0, 100.0), "k_1": (1.0, 100.0), "k_2": (0.5, 30.0), "dispersion": (0.01, 0.32)}
KAPPA = 1e4  # kPa, which an incompressible map does not read

UNIT_SIZE = {"L10": 1.0, "L20": 1.0, "thick": 1.0}

# Each law, its values, and pyMechT's models with theirs; both have fibres at the angle, or along x.
LAWS: dict[str, tuple[dict[str, float], Callable[[Any], Any], dict[str, float]]] = {
    "neo_hookean_split": ({"mu": 12.0}, lambda p: p.NH(), {"mu_0": 12.0}),
    "mooney_rivlin": (
        {"c_10": 4.0, "c_01": 2.0}, lambda p: p.MR(), {"c1_0": 4.0, "c2_0": 2.0},
    ),
    "yeoh": (
        {"c_1": 4.0, "c_2": 2.0, "c_3": 1.0},
        lambda p: p.YEOH(), {"c1_0": 4.0, "c2_0": 2.0, "c3_0": 1.0, "c4_0": 0.0},
    ),
    "holzapfel_ogden_isotropic": (
        {"a": 10.0, "b": 6.0}, lambda p: p.expI1(), {"k1_0": 5.0, "k2_0": 6.0},
    ),
    "may_newman": (
        {"c_0": 0.5, "c_1": 8.0, "c_2": 12.0, "mu": 0.0},
        lambda p: p.MN([np.array([1.0, 0.0, 0.0])]), {"k1_0": 10.0, "k2_0": 8.0, "k3_0": 12.0},
    ),
    "holzapfel_gasser_ogden": (
        {"c": 20.0, "k_1": 30.0, "k_2": 8.0, "angle": ANGLE},
        lambda p: [p.NH(), p.HGO(families())], {"mu_0": 20.0, "k3_1": 30.0, "k4_1": 8.0},
    ),
    "gasser_ogden_holzapfel": (
        {**TRUTH, "angle": ANGLE},
        lambda p: [p.NH(), p.GOH(families())],
        {"mu_0": 20.0, "k1_1": 30.0, "k2_1": 8.0, "k3_1": 0.12},
    ),
}  # fmt: skip


def families() -> list[np.ndarray]:
    """Two families of fibres at the angle from x."""
    c, s = np.cos(np.deg2rad(ANGLE)), np.sin(np.deg2rad(ANGLE))
    return [np.array([c, s, 0.0]), np.array([c, -s, 0.0])]


def stretches() -> np.ndarray:
    """The states (m, 2) of three biaxial tests."""
    return np.concatenate([1.0 + np.outer(STRAINS, ratio) for ratio in RATIOS])


def peer() -> ModuleType:
    """The package, which :class:`InputError` asks to install."""
    try:
        import pymecht
    except ImportError as error:
        install = "pip install pymecht 'pyDOE<0.9'"
        raise InputError(f"compares with pymecht: {install} ({error})") from None
    return pymecht


def theirs(pymecht: ModuleType, law: str, measure: str) -> Any:
    """The biaxial test of a law in pyMechT."""
    models = LAWS[law][1](pymecht)
    material = pymecht.MatModel(*(models if isinstance(models, list) else [models]))
    with warnings.catch_warnings():  # products of cosines are not symmetric to the last bit
        warnings.simplefilter("ignore")
        return pymecht.PlanarBiaxialExtension(material, force_measure=measure)


def ours(law: str, varied: tuple[str, ...]):
    """The specimen of a law; what does not vary is constant."""
    values = LAWS[law][0] | {"kappa": KAPPA}
    description, given = em.find_law(law), stretches()
    units = {quantity.name: quantity.unit for quantity in description.quantities}
    ranges = {n: RANGES.get(n, (0.5 * values[n], 2.0 * values[n])) for n in varied}
    return em.specimen(
        {"stretch_x": given[:, 0], "stretch_y": given[:, 1]},
        ordered=False,
        law=description,
        parameters=tuple(em.Parameter(n, units[n], *ranges[n]) for n in varied),
        constants={n: v for n, v in values.items() if n not in varied},
        fibres=[1.0, 0.0, 0.0] if description.fibres else None,
        sheets=[0.0, 1.0, 0.0] if description.sheets else None,
    )


def compare(pymecht: ModuleType, law: str) -> Case:
    """The largest difference of stresses, over the largest stress."""
    values, _, parameters = LAWS[law]
    first = next(iter(values))
    scene = ours(law, (first,))
    forward = em.homogeneous(scene, incompressible=True)
    theta = jnp.array([values[first]])
    u, largest = forward(theta), 0.0
    for measure, word in (("cauchy", "cauchy"), ("1pk", "stress"), ("2pk", "second")):
        test = theirs(pymecht, law, measure)
        expected = test.disp_controlled(stretches(), parameters | UNIT_SIZE)
        found = cal.stresses(scene, f"{word}_x,{word}_y")(u, theta)
        error = np.abs(np.asarray(found) - expected).max() / np.abs(expected).max()
        largest = max(largest, float(error))
    return {"relative_difference": largest}


def posterior_by_us(data: np.ndarray) -> Case:
    """Draws of the posterior, their effective number, and processor seconds; compiled before."""
    scene = ours("gasser_ogden_holzapfel", tuple(TRUTH))
    forward = em.homogeneous(scene, incompressible=True)
    observe = cal.stresses(scene, "cauchy_x,cauchy_y")
    model = cal.model(forward, observe, cal.GaussianNoise(sd=SD))
    begin = time.perf_counter()
    cal.sample(model, data, seed=SEED)
    first = time.perf_counter() - begin
    cpu = time.process_time()
    posterior = cal.sample(model, data, seed=SEED + 1)
    cpu = time.process_time() - cpu
    rows = posterior.summary()
    gradient = jax.jit(jax.vmap(jax.grad(lambda theta: jnp.sum(observe(forward(theta), theta)))))
    thetas = jnp.tile(jnp.array(list(TRUTH.values())), (256, 1))
    jax.block_until_ready(gradient(thetas))
    tick = time.process_time()
    jax.block_until_ready(gradient(thetas))
    return {
        "mean": {n: float(row["mean"]) for n, row in rows.items()},
        "sd": {n: float(row["sd"]) for n, row in rows.items()},
        "ess": float(min(row["ess_bulk"] for row in rows.values())),
        "processor_s": cpu,
        "first_s": first,
        "gradient_us": 1e6 * (time.process_time() - tick) / 256,
    }


def posterior_by_them(pymecht: ModuleType, data: np.ndarray, iterations: int) -> Case:
    """The same by pyMechT's random walk: the draws that it returns, from the truth on."""
    test = theirs(pymecht, "gasser_ogden_holzapfel", "cauchy")
    parameters, states = test.parameters, stretches()
    names = {"mu_0": "c", "k1_1": "k_1", "k2_1": "k_2", "k3_1": "dispersion"}
    for name in list(parameters):
        if name not in names:
            parameters.fix(name)
            continue
        low, high = RANGES[names[name]]
        parameters.set_ub(name, high)
        parameters.set_lb(name, low)
        parameters.set(name, TRUTH[names[name]])
    evaluations = 0

    def density(values: Any) -> tuple[float, Any]:
        nonlocal evaluations
        evaluations += 1
        misfit = float(np.sum(((test.disp_controlled(states, values) - data) / SD) ** 2))
        return float(np.exp(-0.5 * misfit)), None

    np.random.seed(SEED)  # noqa: NPY002 - pyMechT draws from it
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        chain = pymecht.MCMC(density, parameters)
        cpu = time.process_time()
        chain.run(iterations)
        cpu = time.process_time() - cpu
    draws = np.array(chain.get_samples())
    return {
        "evaluations": evaluations,
        "accepted": len(draws),
        "ess": effective(draws[None]) if len(draws) > 10 else 0.0,
        "processor_s": cpu,
        "mean": dict(zip(TRUTH, draws.mean(axis=0).tolist(), strict=True)),
        "sd": dict(zip(TRUTH, draws.std(axis=0).tolist(), strict=True)),
    }


def effective(draws: np.ndarray) -> float:
    """Return the effective number of draws (chains, s, p) of the slowest unknown."""
    from calibrate.arviz import array_stats

    return float(min(array_stats.ess(draws[..., k]) for k in range(draws.shape[-1])))


def draw(cases: list[Case], path: Path) -> None:
    """Draw the stresses' differences, and effective draws a second."""
    figure, (left, right) = pyplot().subplots(1, 2, figsize=(9.0, 3.4), layout="constrained")
    laws = [case for case in cases if "relative_difference" in case]
    differences = [max(case["relative_difference"], 1e-17) for case in laws]
    left.barh([case["name"] for case in laws], differences, color=BLUE)
    left.set(xscale="log", xlabel="largest difference of a stress, relative", xlim=(1e-17, 1e-6))
    left.invert_yaxis()
    rates = {case["name"]: case["ess"] / case["processor_s"] for case in cases if "ess" in case}
    right.barh(list(rates), [max(rate, 1e-3) for rate in rates.values()], color=[BLUE, ORANGE])
    right.set(xscale="log", xlabel="effective draws by processor second")
    right.invert_yaxis()
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    save(figure, path)


def main() -> None:
    """Run the study."""
    arguments = parser(__doc__, HERE).parse_args()
    pymecht = peer()
    results = Results(arguments.out, SEED, again=arguments.again)
    for law in list(LAWS)[-1:] if arguments.quick else LAWS:
        results.case(law, lambda law=law: compare(pymecht, law))
    test = theirs(pymecht, "gasser_ogden_holzapfel", "cauchy")
    exact = test.disp_controlled(stretches(), LAWS["gasser_ogden_holzapfel"][2] | UNIT_SIZE)
    data = exact + SD * np.random.default_rng(SEED).normal(size=exact.shape)
    iterations = 300 if arguments.quick else 20_000
    results.case("this package", lambda: posterior_by_us(data))
    results.case("pyMechT", lambda: posterior_by_them(pymecht, data, iterations))
    by_name = {case["name"]: case for case in results.cases}
    rates = {n: by_name[n]["ess"] / by_name[n]["processor_s"] for n in ("this package", "pyMechT")}
    ratio = rates["this package"] / max(rates["pyMechT"], 1e-6)
    results.write(rates=rates, ratio=ratio)
    draw(results.cases, arguments.out / "pymecht.png")
    print(f"effective draws by processor second: {rates}, ratio {ratio:.0f}", file=sys.stderr)
    assert all(case.get("relative_difference", 0.0) < 1e-8 for case in results.cases)
    assert arguments.quick or ratio > 100.0


if __name__ == "__main__":
    run(main)
