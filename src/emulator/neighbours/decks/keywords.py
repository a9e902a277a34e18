"""Keyword blocks of an input file of Abaqus or CalculiX, with their lines."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from emulator.neighbours.decks.deck import DeckFile, read_text

_DEEPEST = 10  # files that include one another


@dataclass(eq=False)
class Block:
    """A keyword, its options by name in capitals, and its rows of words.

    lines : the line of each row.
    line : the line of the keyword; of an included file, that of the ``*Include``.
    """

    keyword: str
    line: int
    options: dict[str, str]
    rows: list[list[str]] = field(default_factory=list)
    lines: list[int] = field(default_factory=list)

    def described(self) -> str:
        """Return the keyword with its options."""
        options = (f"{k}={v}" if v else k for k, v in self.options.items())
        return ", ".join([f"*{self.keyword}", *options])

    @property
    def first(self) -> list[str]:
        """The words of the first row; none without rows."""
        return self.rows[0] if self.rows else []

    def words(self) -> list[str]:
        """Return the words of all rows."""
        return [word for row in self.rows for word in row if word]

    def numbered(self) -> Iterator[tuple[int, list[str]]]:
        """Yield each row's line and words."""
        return zip(self.lines, self.rows, strict=True)


def read_blocks(file: DeckFile) -> list[Block]:
    """Return the blocks of a deck and of the files that it includes."""
    blocks: list[Block] = []
    _read(file, file.path, None, blocks, 0)
    return blocks


def _read(file: DeckFile, path: Path, at: int | None, blocks: list[Block], depth: int) -> None:
    """Append the blocks of a file; ``at`` is the line of the deck that includes it."""
    header: Block | None = None  # a keyword that goes on in the next line
    for number, text in enumerate(read_text(path).splitlines(), start=1):
        line, text = (number if at is None else at), text.strip()
        if not text or text.startswith("**"):
            continue
        words = [word.strip().strip('"') for word in text.split(",")]
        if header is not None:
            header.options |= _options(words)
        elif text.startswith("*"):
            keyword = " ".join(words[0][1:].upper().split())
            blocks.append(Block(keyword, line, _options(words[1:])))
        elif not blocks:
            raise file.error(line, f"'{text[:40]}'; expected a keyword, such as *Node")
        else:
            blocks[-1].rows.append(words)
            blocks[-1].lines.append(line)
            continue
        header = None if words[-1] else blocks[-1]
        if header is None and blocks[-1].keyword == "INCLUDE":
            if depth == _DEEPEST:
                raise file.error(line, f"more than {_DEEPEST} files that include one another")
            name = blocks.pop().options.get("INPUT", "")
            _read(file, file.neighbour(name, line), line, blocks, depth + 1)


def _options(words: list[str]) -> dict[str, str]:
    pairs = [word.partition("=") for word in words if word]
    return {" ".join(key.upper().split()): value.strip(' "') for key, _, value in pairs}
