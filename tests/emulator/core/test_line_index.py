import json
import tomllib

from emulator.core.line_index import json_lines, line_of, toml_lines

TOML = '''# a = 1
law = "x"  # [not.a.table]
"quoted key" = """
b = 2
[c]
"""
list = [ # with ] in a comment
  "]", 'd = "',
  [1, 2],
]
dotted.key."of three" = 1

[table.sub]
k = { inline = 1, other = [1, 2] }
  indented = """ends in a quote""""

[[array]]
kind = "one"
[[array]]
[array.inner]
deep = '\'
[[array.inner2]]
kind = \'\'\'
[[array]]
\'\'\'
[[array]]'''


def test_toml_keys_have_the_line_they_are_written_on():
    tomllib.loads(TOML)
    lines = toml_lines(TOML)
    written = TOML.splitlines()
    expected = {
        ("law",): "law =",
        ("quoted key",): '"quoted key"',
        ("list",): "list",
        ("dotted",): "dotted",
        ("dotted", "key", "of three"): "dotted",
        ("table", "sub"): "[table.sub]",
        ("table", "sub", "k"): "k = {",
        ("table", "sub", "indented"): "  indented",
        ("array", 0, "kind"): 'kind = "one"',
        ("array", 1, "inner"): "[array.inner]",
        ("array", 1, "inner", "deep"): "deep",
        ("array", 1, "inner2", 0, "kind"): "kind = '''",
    }
    for path, start in expected.items():
        assert written[lines[path] - 1].startswith(start), path
    arrays = [k for k, line in enumerate(written, start=1) if line == "[[array]]"]
    assert [lines["array", k] for k in range(3)] == [arrays[0], arrays[1], arrays[3]]
    assert not {"a", "b", "c", "d"} & {path[0] for path in lines}


def test_every_key_of_the_file_is_found_and_no_other():
    def paths(entries, path=()):
        for key, value in entries.items() if isinstance(entries, dict) else enumerate(entries):
            tables = isinstance(value, dict) or (
                isinstance(value, list) and value and all(isinstance(v, dict) for v in value)
            )
            yield (*path, key)
            if tables:
                yield from paths(value, (*path, key))

    assert set(toml_lines(TOML)) == set(paths(tomllib.loads(TOML)))


def test_a_path_without_a_line_has_the_line_of_its_table():
    lines = toml_lines("a = 1\n[table]\nk = {inline = 1}\n")
    assert line_of(lines, ("table", "k", "inline", 0)) == 3
    assert line_of(lines, ("table", "missing")) == 2
    assert line_of(lines, ("missing",)) is None
    assert line_of(lines, ()) is None


def test_windows_line_ends_and_an_empty_file():
    assert toml_lines("a = 1\r\n\r\n[t]\r\nb = 2\r\n")["t", "b"] == 4
    assert toml_lines("") == {}


def test_json_keys():
    text = json.dumps(
        {"a": {"b": 'c": {'}, "list": [{"d": 1}, [2, {"e": None}]], "z": []}, indent=1
    )
    lines = json_lines(text)
    written = text.splitlines()
    for path in [("a",), ("a", "b"), ("list",), ("list", 0, "d"), ("list", 1, 1, "e"), ("z",)]:
        assert written[lines[path] - 1].strip().startswith(f'"{path[-1]}":'), path
    assert len(lines) == 6


def test_the_time_is_linear_in_the_number_of_lines():
    """A list, a string, and a JSON list of 40 000 lines; in quadratic time they take minutes."""
    rows = 40_000
    text = "a = [\n" + "  1.0,\n" * rows + ']\nb = """\n' + "c = [1\n" * rows + '"""\nd = 2\n'
    lines = toml_lines(text)
    assert lines == {("a",): 1, ("b",): rows + 3, ("d",): 2 * rows + 5}
    records = ",\n".join(['{"e": 1}'] * rows)
    assert json_lines(f"[{records}]")[rows - 1, "e"] == rows
