"""Where JAX computes: FEM refuses an accelerator in one line, and threads compute where asked.

Where float64 has been switched off, what needs it says so; what does not, works.
"""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import emulator as em
from emulator.core import machine
from emulator.core.errors import InputError
from emulator.surrogates.pod_gp import ReducedForward

THREADS = """
import jax
from emulator.fem.campaign import in_order
first, second = jax.devices()

def where(_):
    (device,) = jax.numpy.zeros(2).devices()
    return device

assert all(d == first for d in in_order(where, iter(range(6)), 2))
with jax.default_device(second):
    assert all(d == second for d in in_order(where, iter(range(6)), 2))
"""


def test_fem_on_an_accelerator_is_refused_in_one_line(monkeypatch, beam):
    monkeypatch.setattr(machine, "_platform", lambda: "cuda")
    with pytest.raises(InputError, match=r"FEM runs on the CPU, .* 'cuda'; set JAX_PLATFORMS=cpu"):
        em.Simulator(beam)


def test_threads_compute_where_the_one_that_asked_does():
    environment = {**os.environ, "XLA_FLAGS": "--xla_force_host_platform_device_count=2"}
    told = subprocess.run(
        [sys.executable, "-c", THREADS],
        env=environment, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert told.returncode == 0, told.stderr


def test_fem_needs_float64(beam):
    with jax.enable_x64(False), pytest.raises(InputError, match="FEM needs float64"):
        em.Simulator(beam).solve(np.asarray(beam.centre))


@pytest.mark.parametrize("compiled", [False, True])
def test_a_discrepancy_model_needs_float64(compiled):
    """Its weights are large and cancel: the shipped ventricle was 9 mm off in float32."""
    forward = em.load("once_clamped_beam", kind="series").cache(np.array([3]))
    call = jax.jit(forward) if compiled else forward
    theta = np.asarray(forward.scene.centre)
    with jax.enable_x64(False), pytest.raises(InputError, match="discrepancy model needs float64"):
        call(jnp.asarray(theta, jnp.float32))


@pytest.mark.parametrize("compiled", [False, True])
def test_a_reduced_model_needs_float64(beam, compiled):
    """As large: that of 30 runs of the shipped beam was 2 mm off, and 1e-5 mm in float64."""
    inputs, ones = np.array([[0.2, 0.3], [0.6, 0.5], [0.8, 0.1]]), np.ones((1, 3))
    forward = ReducedForward(beam, np.array([3]), np.zeros((1, 3)), ones[None], inputs, ones[:, :2],
                             ones)  # fmt: skip
    call = jax.jit(forward) if compiled else forward
    with jax.enable_x64(False), pytest.raises(InputError, match="reduced model needs float64"):
        call(jnp.asarray(beam.centre, jnp.float32))


@pytest.mark.filterwarnings("ignore:Explicitly requested dtype")
def test_a_network_alone_works_in_float32():
    forward = em.load("once_clamped_beam").cache(np.array([3]))
    theta = np.asarray(forward.scene.centre)
    wide = np.asarray(forward(jnp.asarray(theta)))
    with jax.enable_x64(False):
        narrow = np.asarray(forward(jnp.asarray(theta, jnp.float32)))
    assert narrow.dtype == np.float32
    np.testing.assert_allclose(narrow, wide, rtol=1e-5, atol=1e-5)


def test_blas_is_held_to_one_thread_and_let_go():
    def threads():
        return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}

    inside = machine.one_blas_thread()(threads)
    with threadpool_limits(2, user_api="blas"):
        assert inside() == inside() == {1}
        with machine.one_blas_thread():
            assert threads() == {1}
        assert threads() == {2}


@pytest.mark.parametrize(
    ("groups", "files", "cores", "memory"),
    [
        (
            "0::/job/step\n",
            {"job/cpu.max": "150000 100000", "job/step/memory.max": "4096"},
            1,
            4096,
        ),
        ("0::/job\n", {"job/cpu.max": "50000 100000", "job/memory.max": "max"}, 1, None),
        ("0::/../host\n", {"cpu.max": "max 100000", "memory.max": "8192\n"}, None, 8192),
        (
            "5:cpu,cpuacct:/a\n3:memory:/a\n1:name=systemd:/a\n",
            {
                "cpu,cpuacct/a/cpu.cfs_quota_us": "100000",
                "cpu,cpuacct/a/cpu.cfs_period_us": "100000",
                "memory/a/memory.limit_in_bytes": "9223372036854771712",
                "memory/memory.limit_in_bytes": "2048",
            },
            1,
            2048,
        ),
        (
            "5:cpu:/\n",
            {"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"},
            None,
            None,
        ),
    ],
)
def test_limits_of_a_container(monkeypatch, tmp_path, groups, files, cores, memory):
    """Control groups of versions 2 and 1: quota over period, rounded down, and bytes."""
    (tmp_path / "none").write_text("")
    monkeypatch.setattr(machine, "PROCESS_GROUPS", tmp_path / "none")
    free = machine.cores(), machine.memory()
    (tmp_path / "process").write_text(groups)
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.setattr(machine, "PROCESS_GROUPS", tmp_path / "process")
    monkeypatch.setattr(machine, "GROUPS", tmp_path)
    assert (machine.cores(), machine.memory()) == (cores or free[0], memory or free[1])
