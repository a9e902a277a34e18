"""One self-contained HTML page of a posterior, for a colleague: verdict, data, body, provenance.

It opens without a network: the drawing library is inside.
"""

from __future__ import annotations

from pathlib import Path

from emulator.core.errors import InputError

__all__ = ["write_report"]


def write_report(folder: str | Path, out: str | Path | None = None, *, fem: bool = True) -> Path:
    """Write one HTML file about a posterior or a population, and return its path.

    Parameters
    ----------
    folder : the folder that :func:`calibrate.project.infer` wrote, or that of a population
        (:func:`calibrate.project.members.infer_members`).
    out : the file to write, ``folder/report.html`` by default.
    fem : whether to solve once at the posterior's mean, to show the map's error on the body;
        nothing is solved for a population.

    Raises
    ------
    InputError
        Plotly or Jinja2 is not installed; ``folder`` holds neither a posterior nor a population, or
        the posterior of another run or map.
    """
    try:
        from calibrate.report.page import write_page
    except ModuleNotFoundError as error:
        extra = "pip install 'soft-tissue-calibrate[plot]'"
        raise InputError(f"a report needs {error.name}: {extra}") from error
    return write_page(folder, out, fem=fem)
