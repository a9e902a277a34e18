"""What an accelerator gains: the same batches on it and on the CPU beside it.

    python -m studies.decoder_speed.accelerator --out DIR

Values with gradients of a log posterior, particles of SMC, steps of training. Writes
accelerator.json; where JAX knows no accelerator the CPU stands alone.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import jax
from studies.common.output import study_header
from studies.common.timing import milliseconds, per_call
from studies.samplers.problems import problem

import calibrate as cal
import emulator as em
from calibrate.samplers.smc import SMCOptions
from calibrate.statistical_model import Data, Model
from calibrate.statistical_model.density import density_of
from emulator.core.store import write_json
from emulator.training.job import Job
from emulator.training.paper import Paper, prepare

HERE = Path(__file__).parent
SEED = 12
OBSERVED = "24 landmarks and volume"


def gradients(model: Model, data: Data, size: int) -> float:
    """Seconds of a batch of values and gradients of the log posterior."""
    density = density_of(model)
    keys = jax.random.split(jax.random.key(SEED), 6 * size).reshape(6, size)
    points = jax.jit(jax.vmap(jax.vmap(density.prior_draw)))(keys)
    value = jax.value_and_grad(lambda z: density.log_density(z, data))
    return per_call(jax.jit(jax.vmap(value)), points)


def particles(model: Model, data: dict[str, Any], size: int) -> dict[str, Any]:
    """Seconds of SMC with ``size`` particles, compiled before."""
    options = SMCOptions(draws=size, chains=1)
    for seed in (SEED, SEED + 1):
        began = time.perf_counter()
        told = cal.sample(model, data, sampler="smc", options=options, seed=seed, predictions=False)
        seconds = time.perf_counter() - began
    mean = {name: float(told.tree["posterior"][name].mean()) for name in model.names}
    return {"seconds": seconds, "mean": mean}


def step_s(device: jax.Device, batch: int, steps: int) -> float:
    """Seconds of a step of the paper's training, ``batch`` theta each, prepared on the CPU."""
    plan = Paper(steps=steps, batch=batch)
    with jax.default_device(jax.devices("cpu")[0]):
        training = prepare(plan, Job(em.load("left_ventricle", kind="series").scene)).training
        state = training.initial(steps)
    state = jax.device_put(state, device)
    for _ in range(3):
        state = training.advance(state)
    began = time.perf_counter()
    for _ in range(steps):
        state = training.advance(jax.block_until_ready(state))
    jax.block_until_ready(state)
    assert device in jax.tree.leaves(state.weights)[0].devices()
    return (time.perf_counter() - began) / steps


def measured(device: jax.Device, *, quick: bool) -> dict[str, Any]:
    """Times on a device; of the CPU without particles, which take it minutes."""
    model, data = problem(OBSERVED, SEED)
    checked = model.check_data(data)
    found: dict[str, Any] = {"gradients_s": {}, "particles": {}, "step_s": {}}
    for size in (1, 64) if quick else (1, 64, 1024, 16384):
        found["gradients_s"][size] = seconds = gradients(model, checked, size)
        print(f"{size:6d} gradients {milliseconds(seconds)}", flush=True)
    for batch in (1,) if quick else (1, 64):
        found["step_s"][batch] = seconds = step_s(device, batch, 3 if quick else 20)
        print(f"step of {batch} theta {milliseconds(seconds)}", flush=True)
    for size in (100,) if quick else () if device.platform == "cpu" else (250, 16000):
        found["particles"][size] = told = particles(model, data, size)
        print(f"{size:6d} particles {told}", flush=True)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="small batches")
    parser.add_argument("--out", type=Path, default=HERE)
    words = parser.parse_args()
    words.out.mkdir(parents=True, exist_ok=True)
    cases = []
    for device in dict.fromkeys((jax.devices()[0], jax.devices("cpu")[0])):
        print(device.device_kind, flush=True)
        with jax.default_device(device):
            case = measured(device, quick=words.quick)
        cases.append({"name": device.device_kind, "status": "done", **case})
        content = {**study_header(HERE, SEED), "cases": cases}
        write_json(words.out / "accelerator.json", content)


if __name__ == "__main__":
    main()
