"""XML with line numbers, read without entities: a document type is refused, files are not opened.

A document type may define entities that expand without end, or name files and addresses. No deck
needs one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from xml.parsers import expat

from emulator.core.errors import InputError
from emulator.neighbours.decks.deck import DeckFile, read_text

_DEEPEST = 100  # tags within one another


@dataclass(eq=False)
class Tag:
    """One element of an XML file: its name, attributes, text and children, and its line."""

    name: str
    line: int
    attributes: dict[str, str] = field(default_factory=dict)
    children: list[Tag] = field(default_factory=list)
    text: str = ""

    def all(self, *names: str) -> Iterator[Tag]:
        """Yield the children of these names."""
        return (child for child in self.children if child.name in names)

    def first(self, *names: str) -> Tag | None:
        """Return the first child of one of these names."""
        return next(self.all(*names), None)

    def words(self, name: str, default: str = "") -> str:
        """Return the text of the first child called ``name``."""
        child = self.first(name)
        return default if child is None else child.text

    def described(self) -> str:
        """Return the tag as it is written, without its content."""
        attributes = "".join(f' {name}="{value}"' for name, value in self.attributes.items())
        return f"<{self.name}{attributes}>"


def read_tags(file: DeckFile) -> Tag:
    """Return the outermost tag of a file; :class:`InputError` where it is not valid XML."""
    text = read_text(file.path)
    parser = expat.ParserCreate("utf-8")
    parser.buffer_text = True
    open_tags = [Tag("", 0)]

    def start(name: str, attributes: dict[str, str]) -> None:
        tag = Tag(name, parser.CurrentLineNumber, attributes)
        open_tags[-1].children.append(tag)
        open_tags.append(tag)
        if len(open_tags) > _DEEPEST:
            raise file.error(tag.line, f"tags are nested deeper than {_DEEPEST}")

    def end(_: str) -> None:
        tag = open_tags.pop()
        tag.text = tag.text.strip()

    def content(text: str) -> None:
        open_tags[-1].text += text

    def refuse(*_: object) -> None:
        line = parser.CurrentLineNumber
        raise file.error(line, "it has a document type (<!DOCTYPE>); remove that line")

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = content, refuse
    try:
        # The text is decoded already, whatever its first line says.
        parser.Parse(text.encode("utf-8"), True)
    except expat.ExpatError as error:
        reason = expat.errors.messages.get(error.code, "error")
        raise InputError(
            f"deck {file.path}, line {error.lineno}: it is not valid XML ({reason})"
        ) from error
    return open_tags[0].children[0]


def number(file: DeckFile, tag: Tag, name: str, default: float | None = None) -> float:
    """Return the number of a child; ``default`` without one, or an error where that is None."""
    child = tag.first(name)
    if child is None and default is not None:
        return default
    if child is None:
        raise file.error(tag.line, f"{tag.described()} has no <{name}>")
    if child.attributes.get("type", "const") != "const":
        raise file.error(child.line, f"{child.described()}; expected a number")
    return file.numbers(child.text, child.line, 1)[0]
