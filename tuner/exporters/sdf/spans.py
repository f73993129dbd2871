"""XML with the place of every element in its text, and edits of the text by place.

Jinja templates of models are read with their expressions blanked out, or rendered.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from tuner.core.errors import ExportError

_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
_FILLER = "J"


@dataclass
class Element:
    """An element and where it lies.

    Attributes
    ----------
    tag, attributes
        As written.
    start, end
        The whole element is ``text[start:end]``.
    content, content_end
        What lies between its tags is ``text[content:content_end]``; empty for ``<tag/>``.
    children
        Elements directly inside.
    """

    tag: str
    attributes: Mapping[str, str]
    start: int
    content: int
    content_end: int = 0
    end: int = 0
    children: list[Element] = field(default_factory=list)

    def all(self, tag: str) -> Iterator[Element]:
        """Yield every element of a tag inside, at any depth, in the order of the text."""
        for child in self.children:
            if child.tag == tag:
                yield child
            yield from child.all(tag)

    def find(self, *tags: str) -> Element | None:
        """Return the element at a path of tags from here, the first of each; None without one."""
        element: Element | None = self
        for tag in tags:
            element = next((c for c in element.children if c.tag == tag), None) if element else None
        return element


@dataclass(frozen=True)
class Edit:
    """A piece of text to put in the place of another."""

    start: int
    end: int
    text: str


def parse(text: str, path: Path) -> Element:
    """Return the root element of an XML text.

    Parameters
    ----------
    text
        Characters; places count in them.
    path
        For error messages.

    Raises
    ------
    ExportError
        It is not well-formed, or declares a document type (entities are not expanded here).
    """
    # One byte a character, so that the parser's byte places are places in the text.
    plain = re.sub(r"[^\x00-\x7f]", "x", without_comments(text))
    parser = expat.ParserCreate("utf-8")
    top = Element("", {}, 0, 0)
    open_elements = [top]

    def start(tag: str, attributes: dict[str, str]) -> None:
        place = parser.CurrentByteIndex
        element = Element(tag, attributes, place, _after_tag(plain, place))
        open_elements[-1].children.append(element)
        open_elements.append(element)

    def end(_: str) -> None:
        element = open_elements.pop()
        if plain[element.content - 2] == "/":
            element.content_end = element.end = element.content
        else:
            element.content_end = parser.CurrentByteIndex
            element.end = _after_tag(plain, element.content_end)

    def refuse(*_: object) -> None:
        raise ExportError(path, "declares a document type", "remove its <!DOCTYPE>")

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(plain, True)
    except expat.ExpatError as error:
        raise ExportError(path, f"is not well-formed XML ({error})", "correct it") from None
    return top.children[0]


def without_comments(text: str) -> str:
    """Return a text of the same length with comments as space: simulators take ``--`` in them."""
    return _COMMENT.sub(lambda match: re.sub(r"[^\n]", " ", match.group()), text)


def _after_tag(text: str, start: int) -> int:
    """Return the place after the ``>`` that ends the tag beginning at a place."""
    quote = ""
    for place in range(start, len(text)):
        character = text[place]
        if quote:
            quote = "" if character == quote else quote
        elif character in "\"'":
            quote = character
        elif character == ">":
            return place + 1
    return len(text)


def content(element: Element, text: str) -> str:
    """Return what an element holds, without comments and surrounding space."""
    return _COMMENT.sub("", text[element.content : element.content_end]).strip()


def number(element: Element, text: str) -> float | None:
    """Return the number that an element holds, None if it holds something else."""
    try:
        return float(content(element, text))
    except ValueError:
        return None


def set_value(element: Element, text: str, value: str) -> Edit:
    """Return the edit that gives a childless element another value, its comments kept."""
    if element.content == element.end:
        start_tag = text[element.start : element.end].rstrip("/>").rstrip()
        return Edit(element.start, element.end, f"{start_tag}>{value}</{element.tag}>")
    inside = text[element.content : element.content_end]
    masked = without_comments(inside)
    match = _NUMBER.search(masked)
    if match and match.group() == masked.strip():
        return Edit(element.content + match.start(), element.content + match.end(), value)
    return Edit(element.content, element.content_end, value)


def append_child(parent: Element, text: str, tag: str, value: str) -> Edit:
    """Return the edit that adds an element behind the last child, indented like it."""
    if not parent.children:
        return Edit(parent.content, parent.content, f"<{tag}>{value}</{tag}>")
    last = parent.children[-1]
    before = text[text.rfind("\n", 0, last.start) + 1 : last.start]
    separator = "\n" + before if not before.strip() else ""
    return Edit(last.end, last.end, f"{separator}<{tag}>{value}</{tag}>")


def apply(text: str, edits: Iterable[Edit]) -> str:
    """Return the text with all edits done; they must not overlap."""
    pieces: list[str] = []
    place = 0
    for edit in sorted(edits, key=lambda edit: (edit.start, edit.end)):
        if edit.start < place:
            raise ValueError(f"edits overlap at {edit.start}")
        pieces += (text[place : edit.start], edit.text)
        place = edit.end
    return "".join((*pieces, text[place:]))


_EXPRESSION = re.compile(r"\{\{.*?\}\}", re.DOTALL)
_STATEMENT = re.compile(r"\{%.*?%\}|\{#.*?#\}", re.DOTALL)


def is_template(text: str) -> bool:
    """Return whether a text holds Jinja expressions, statements or comments."""
    return bool(_EXPRESSION.search(text) or _STATEMENT.search(text))


def blanked(text: str) -> str:
    """Return a text of the same length and lines without Jinja in it.

    Expressions become letters, so that they are no numbers; statements and comments become space.
    """
    text = _STATEMENT.sub(lambda match: re.sub(r"[^\n]", " ", match.group()), text)
    return _EXPRESSION.sub(lambda match: re.sub(r"[^\n]", _FILLER, match.group()), text)


def rendered(text: str, path: Path) -> str:
    """Return what a template gives with no variables set; a text without Jinja as it is.

    Raises
    ------
    ExportError
        It cannot be rendered so.
    """
    if not is_template(text):
        return text
    from jinja2 import TemplateError  # noqa: PLC0415
    from jinja2.sandbox import SandboxedEnvironment  # noqa: PLC0415

    try:
        return SandboxedEnvironment(keep_trailing_newline=True).from_string(text).render()
    except (TemplateError, TypeError, ValueError, ArithmeticError) as error:
        raise ExportError(
            path, f"cannot be rendered without variables ({error})", "give it defaults"
        ) from None
