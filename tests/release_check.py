"""Whether a version may be released: ``python tests/release_check.py [TAG]``, by ``make release``.

The version of pyproject.toml is that of the top of CHANGELOG.md and of CITATION.cff. With a tag,
``v`` and the version, both have the day of the release as well.
"""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
DAY = r"\d{4}-\d{2}-\d{2}"


class Version(NamedTuple):
    """A version in one file, and the day of its release; empty where the file has none."""

    number: str
    day: str = ""


def versions(project: str, changelog: str, citation: str) -> dict[str, Version]:
    """Return the version that the text of each file has, by the file's name."""
    top = re.search(r"^## (\S+)(?: \((.*)\))?$", changelog, re.MULTILINE)
    cited = re.search(r"^version: (\S+)$", citation, re.MULTILINE)
    cited_day = re.search(rf"^date-released: [\"']?({DAY})[\"']?$", citation, re.MULTILINE)
    day = top[2] if top and re.fullmatch(DAY, top[2] or "") else ""
    return {
        "pyproject.toml": Version(tomllib.loads(project)["project"]["version"]),
        "CHANGELOG.md": Version(top[1] if top else "none", day),
        "CITATION.cff": Version(cited[1] if cited else "none", cited_day[1] if cited_day else ""),
    }


def problems(files: dict[str, Version], tag: str = "") -> Iterator[str]:
    """Yield one sentence per disagreement of the files with each other, or with the tag."""
    number = files["pyproject.toml"].number
    for file, version in files.items():
        if version.number != number:
            yield f"{file} has version {version.number}, pyproject.toml {number}"
    if not tag:
        return
    if tag != f"v{number}":
        yield f"the tag is {tag}, the version of pyproject.toml {number}: tag it v{number}"
    changelog, citation = files["CHANGELOG.md"].day, files["CITATION.cff"].day
    if not changelog:
        yield f"CHANGELOG.md has no day of release: begin it with '## {number} (YYYY-MM-DD)'"
    if not citation:
        yield "CITATION.cff has no day of release: add 'date-released: YYYY-MM-DD'"
    if changelog and citation and changelog != citation:
        yield f"CHANGELOG.md says {changelog}, CITATION.cff {citation}"


def main(tag: str = "") -> int:
    """Print the version, or what is wrong; return 1 if something is."""
    names = ("pyproject.toml", "CHANGELOG.md", "CITATION.cff")
    files = versions(*((ROOT / name).read_text(encoding="utf-8") for name in names))
    wrong = list(problems(files, tag))
    print(
        *wrong or [f"version {files['pyproject.toml'].number}: {', '.join(names)} agree"], sep="\n"
    )
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:2]))
