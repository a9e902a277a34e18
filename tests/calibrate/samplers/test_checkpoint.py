"""A sampler that is killed goes on to the draws of an uninterrupted run."""

from functools import partial

import jax
import numpy as np
import pytest

import calibrate as cal
from calibrate.samplers import SAMPLERS, options_from
from emulator.core.checkpoint import Checkpoint
from emulator.core.errors import InputError
from linear_support import linear_problem


class Killed(Exception):
    pass


def kill_after(monkeypatch, writes):
    """Writes at every opportunity, and a kill after so many; returns what counts them."""
    keep, written = Checkpoint.keep, []

    def kept(self, state):
        self.every = 0.0
        keep(self, state)
        if self.path is not None:
            written.append(self.path)
        if len(written) == writes:
            raise Killed

    monkeypatch.setattr(Checkpoint, "keep", kept)
    # Opportunities come by the clock; here a first iteration, then fifty at a time.
    monkeypatch.setattr("calibrate.samplers.chains._SHOWN", 1e9)
    return written


@pytest.fixture(scope="module")
def problem(beam):
    return linear_problem(beam)


def run(problem, name, **more):
    model, data = problem
    options = options_from(SAMPLERS[name], {}, warmup=60, draws=120, chains=2)
    return cal.sample(model, data, sampler=name, options=options, seed=5, predictions=False, **more)


# A run of these takes seconds, and begins again.
SHORT = ("auto", "importance")


@pytest.mark.parametrize(
    "name",
    [
        n if n == "nuts" else pytest.param(n, marks=pytest.mark.slow)
        for n in SAMPLERS
        if n not in SHORT
    ],
)
def test_a_killed_run_goes_on_to_the_same_draws(name, problem, monkeypatch, tmp_path):
    """Killed early, in the pilot run or the first population, in the middle and at the end."""
    path = tmp_path / "sampling.safetensors"
    with monkeypatch.context() as patch:
        written = kill_after(patch, None)
        whole = run(problem, name, checkpoint=path)
    for writes in sorted({max(1, k * len(written) // 3) for k in range(4)}):
        with monkeypatch.context() as patch:
            kill_after(patch, writes)
            with pytest.raises(Killed):
                run(problem, name, checkpoint=path)
        assert path.exists()
        resumed = run(problem, name, checkpoint=path)
        assert not path.exists()
        for group in ("posterior", "sample_stats"):
            for variable, values in whole.tree[group].data_vars.items():
                np.testing.assert_array_equal(resumed.tree[group][variable].values, values.values)
        assert resumed.tree.attrs == whole.tree.attrs


def test_a_run_does_go_on_and_does_not_begin_again(problem, monkeypatch, tmp_path):
    """Draws spoiled in the file are found in the result."""
    from emulator.core.store import read_arrays, save_arrays

    path = tmp_path / "sampling.safetensors"
    with monkeypatch.context() as patch:
        kill_after(patch, 9)
        with pytest.raises(Killed):
            run(problem, "nuts", checkpoint=path)
    arrays, metadata = read_arrays(path)
    arrays["draws/statistics/lp"][0, 3] = -1234.5
    save_arrays(path, arrays, metadata)
    assert run(problem, "nuts", checkpoint=path).tree["sample_stats"]["lp"].values[0, 3] == -1234.5


def test_slow_iterations_are_shown_and_kept_one_by_one(problem, monkeypatch, tmp_path, capsys):
    """Draws do not depend on it, and long trajectories are named."""
    whole = run(problem, "nuts")
    written = kill_after(monkeypatch, None)
    for name, value in (("chains._SHOWN", 0.0), ("chains._MANY_STEPS", 0)):
        monkeypatch.setattr(f"calibrate.samplers.{name}", value)
    monkeypatch.setattr("emulator.core.display.EVERY", 1e-3)
    slow = run(problem, "nuts", checkpoint=tmp_path / "sampling.safetensors", progress=True)
    draws = slow.tree["posterior"].sizes["draw"]
    assert len(written) == 60 + 120 + 60 + draws  # a pilot and the final run, each with its warm-up
    assert "gradients an iteration" in capsys.readouterr().err
    for variable, values in whole.tree["posterior"].data_vars.items():
        np.testing.assert_array_equal(slow.tree["posterior"][variable].values, values.values)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 6}, "belongs to another run: its seed is 5, not 6"),
        ({"data": 0.01}, "belongs to another run: its data is"),
        ({"sampler": "blackjax_nuts"}, "belongs to another run: its sampler is"),
    ],
)
def test_the_checkpoint_of_another_run_is_refused(problem, change, message, monkeypatch, tmp_path):
    path = tmp_path / "sampling.safetensors"
    model, data = problem
    options = cal.samplers.NUTSOptions(50, 50, chains=2)
    call = partial(cal.sample, model, options=options, seed=5, checkpoint=path)
    with monkeypatch.context() as patch:
        kill_after(patch, 1)
        with pytest.raises(Killed):
            call(data)
    before = path.read_bytes()
    more = dict(change)
    data = data + more.pop("data", 0.0)
    if "sampler" in more:
        more["options"] = None
    with pytest.raises(InputError, match=message):
        call(data, **more)
    assert path.read_bytes() == before


def test_keys_and_shapes_come_back(tmp_path):
    state = {"key": jax.random.key(3), "count": np.int64(4), "draws": np.ones((2, 5))}
    checkpoint = Checkpoint(tmp_path / "c.safetensors", {"seed": "1"}, every=0.0)
    checkpoint.keep(lambda: state)
    found = checkpoint.restore(lambda: {**state, "draws": np.ones((2, 1))})
    assert jax.random.uniform(found["key"]) == jax.random.uniform(state["key"])
    assert found["draws"].shape == (2, 5)
    with pytest.raises(InputError, match="has other arrays than this run"):
        checkpoint.restore(lambda: {"key": state["key"]})


def test_nothing_is_written_before_it_is_due(tmp_path):
    path = tmp_path / "c.safetensors"
    Checkpoint(path, {}, every=1e6).keep(lambda: {"a": np.ones(1)})
    assert not path.exists()
    assert Checkpoint(path).restore(dict) is None
