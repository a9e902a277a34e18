"""Where JAX computes: FEM refuses an accelerator in one line, and threads compute where asked."""

import os
import subprocess
import sys

import pytest

import emulator as em
from emulator.core import machine
from emulator.core.errors import InputError

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
