import json
import subprocess
import sys

import numpy as np
import pytest

from emulator.core.errors import InputError
from emulator.core.store import (
    fill_tree,
    inside,
    named_leaves,
    read_arrays,
    read_json,
    replacing,
    save_arrays,
    to_json,
    write_json,
)


def test_a_tree_comes_back(tmp_path):
    tree = {"a": np.arange(3.0), "b": [np.ones((2, 2), np.float32), np.asarray(7)]}
    save_arrays(tmp_path / "t.safetensors", named_leaves(tree), {"note": "x"})
    arrays, metadata = read_arrays(tmp_path / "t.safetensors")
    assert metadata["note"] == "x"
    assert sorted(arrays) == ["a", "b/0", "b/1"]
    assert sorted(inside(arrays, "b")) == ["0", "1"]
    back = fill_tree(tree, arrays, "t")
    np.testing.assert_array_equal(back["b"][0], tree["b"][0])
    assert back["b"][1] == 7
    with pytest.raises(InputError, match="t: array 'c' is missing"):
        fill_tree({"c": np.ones(1)}, arrays, "t")
    with pytest.raises(InputError, match=r"has shape \(3,\); expected \(4,\)"):
        fill_tree({"a": np.ones(4)}, arrays, "t")


def test_an_interrupted_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "deep" / "file.json"
    write_json(path, {"old": 1})

    def interrupted():
        with replacing(path) as temporary:
            temporary.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        interrupted()
    assert '"old": 1' in path.read_text()
    assert [file.name for file in path.parent.iterdir()] == ["file.json"]


def test_json_of_arrays_has_lists_and_null():
    content = {"axis": np.array([0.0, np.nan, 1.0]), "size": (1, np.inf)}
    assert json.loads(to_json(content)) == {"axis": [0.0, None, 1.0], "size": [1, None]}


@pytest.mark.parametrize("depth", [101, 2_000, 20_000, 200_000])
def test_json_that_is_nested_deep_is_refused_in_a_line(tmp_path, depth):
    path = tmp_path / "deep.json"
    for opening, closing in (("[", "]"), ('{"a": ', "}")):
        path.write_text(opening * depth + "1" + closing * depth)
        with pytest.raises(InputError, match="not valid JSON: .* deeper than 100 levels"):
            read_json(path)
    path.write_text("[" * 99 + "1" + "]" * 99)
    assert isinstance(read_json(path), list)


EXCLUDE = """
import os, sys, time
from emulator.core.errors import InputError
from emulator.core.store import exclusive
folder, count, end = sys.argv[1], 0, time.monotonic() + 2.0
while time.monotonic() < end or not count:
    try:
        with exclusive(folder + "/run.json", "run"):
            os.close(os.open(folder + "/mark", os.O_CREAT | os.O_EXCL))  # raises where it is there
            os.unlink(folder + "/mark")
            count += 1
    except InputError:
        pass
"""


def test_two_processes_are_never_both_inside(tmp_path):
    """Each takes the lock thousands of times, and removes its file while the other may open it."""
    (tmp_path / "keep").touch()
    words = [sys.executable, "-c", EXCLUDE, str(tmp_path)]
    pair = [subprocess.Popen(words, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    for process in pair:
        _, said = process.communicate(timeout=60)
        assert process.returncode == 0, said
    assert [path.name for path in tmp_path.iterdir()] == ["keep"]
