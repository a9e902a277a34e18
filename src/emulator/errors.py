"""Errors meant for people: one line that names the thing, what was found, what would be right."""


class InputError(ValueError):
    """Something the user gave cannot be used. The command line prints it and exits with code 2."""


class SolverError(RuntimeError):
    """A simulation did not converge; the message names how it failed."""


def check_seed(seed: int, what: str) -> None:
    """Raise :class:`InputError` for a seed below 0; ``what`` begins the message."""
    if seed < 0:
        raise InputError(f"{what}: seed {seed} is below 0")
