"""``calibrate completion``: the words that the Tab key completes."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any

from calibrate.cli.output import DONE, emit
from calibrate.cli.words import answer

_SHELLS = ("bash", "zsh", "fish")


def add_completion(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "completion",
        help="script that completes calibrate's words in your shell",
        description="Prints a script for bash, zsh or fish that completes commands, options, "
        "scenes, emulators, samplers, recipes and files, without starting calibrate.",
        epilog='bash: eval "$(calibrate completion bash)" in ~/.bashrc; zsh: calibrate completion '
        "zsh > a folder of $fpath/_calibrate; fish: calibrate completion fish > "
        "~/.config/fish/completions/calibrate.fish",
    )
    parser.add_argument("shell", choices=_SHELLS)
    answer(parser, run_completion)


def run_completion(arguments: argparse.Namespace) -> int:
    """Print the script."""
    script = completion(arguments.shell)
    emit(arguments, {"script": script}, script)
    return DONE


def completion(shell: str) -> str:
    """Return the script for a shell, from the parsers of all commands."""
    import shtab

    from calibrate.cli import build_parser
    from emulator.mechanics.laws import LAWS
    from emulator.scenes import BUILT_IN
    from emulator.surrogates.emulator import shipped

    of_words = {
        "SCENE": _words([*BUILT_IN], "toml"),
        "EMULATOR": _words(shipped()),
        "NAME|DIR": _words(shipped()),
        "DIR|fem": _words(["fem"]),
        "synthetic": _words(["synthetic"], "csv"),
    }
    files = {"MESH": shtab.FILE, "NAME|FILE": shtab.FILE, "FILE|synthetic": shtab.FILE}
    by_metavar = {**{key: shtab.cmd(words) for key, words in of_words.items()}, **files}
    parser = build_parser()
    for action in _actions(parser):
        metavar = str(action.metavar)
        if metavar in by_metavar:
            action.complete = by_metavar[metavar]  # type: ignore[attr-defined]
        elif metavar.startswith("DIR"):
            action.complete = shtab.DIRECTORY  # type: ignore[attr-defined]
        elif metavar.startswith("FILE"):
            action.complete = shtab.FILE  # type: ignore[attr-defined]
        elif action.dest == "law":
            action.complete = shtab.cmd(_words([*LAWS]))  # type: ignore[attr-defined]
    return shtab.complete(parser, shell)


def _words(names: list[str], suffix: str = "") -> str:
    """Return a command of any shell that prints names, and files here that end in ``suffix``."""
    print_names = f"printf '%s\\n' {' '.join(sorted(names))}"
    return (
        f"{print_names}; ls | grep '\\.{suffix}$'"
        if suffix
        else f"{print_names}; ls -d */ 2>/dev/null"
    )


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """Yield every argument of a parser and of its commands."""
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from _actions(command)
