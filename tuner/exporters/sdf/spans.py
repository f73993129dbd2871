"""XML elements with their positions in the text, and edits of the text by position.

Jinja templates of models are parsed with their expressions blanked out, or rendered.
"""

from __future__ import annotations

import math
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from tuner.core.errors import ExportError

_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_COMMENT = re.compile(r"<!--.*?(?:-->|\Z)", re.DOTALL)
_TAG = re.compile(r"""(?:[^>"']|"[^"]*"|'[^']*')*>""")
_FILLER = "J"
MAX_DEPTH = 40
"""Elements inside each other in one file."""


@dataclass(frozen=True)
class ModelFile:
    """A file of a model: its raw text, and the text to parse."""

    path: Path
    raw: str
    text: str


@dataclass
class Element:
    """An element and its position.

    Attributes
    ----------
    source
        Its file; positions are in its ``text``.
    start, end
        Of the whole element.
    content, content_end
        Of the content between its tags; empty for ``<tag/>``.
    at
        Of an include that holds the included model: the pose, ``x y z roll pitch yaw``.
    """

    source: ModelFile
    tag: str
    attributes: Mapping[str, str]
    start: int
    content: int
    content_end: int = 0
    end: int = 0
    children: list[Element] = field(default_factory=list)
    at: Sequence[float] = ()

    @property
    def value(self) -> str:
        """Its content without comments and surrounding space."""
        return _COMMENT.sub("", self.source.text[self.content : self.content_end]).strip()

    @property
    def number(self) -> float | None:
        """Its finite number; None for other content."""
        try:
            number = float(self.value)
        except ValueError:
            return None
        return number if math.isfinite(number) else None

    @property
    def numbers(self) -> dict[str, float]:
        """Tag -> number of the elements directly inside; the first of a tag counts."""
        children = reversed(self.children)
        return {child.tag: child.number for child in children if child.number is not None}

    def all(self, tag: str) -> Iterator[Element]:
        """Yield every element of a tag inside, at any depth, in the order of the text."""
        for child in self.children:
            if child.tag == tag:
                yield child
            yield from child.all(tag)

    def first(self, tag: str) -> Element | None:
        """Return the first element of a tag inside, at any depth; None without one."""
        return next(self.all(tag), None)

    def find(self, tag: str) -> Element | None:
        """Return the first element of a tag directly inside; None without one."""
        return next((child for child in self.children if child.tag == tag), None)


@dataclass(frozen=True)
class Edit:
    """The replacement of a part of a file."""

    source: ModelFile
    start: int
    end: int
    text: str


def parse(text: str, path: Path, raw: str | None = None) -> Element:
    """Return the root element of an XML text.

    Parameters
    ----------
    text
        The text to parse, of which positions count.
    raw
        The raw text of the file, if it differs.

    Raises
    ------
    ExportError
        It is not well-formed, is nested too deeply, or declares a document type (entities are not
        expanded here).
    """
    # One byte per character, so that the parser's byte positions are positions in the text.
    plain = re.sub(r"[^\x00-\x7f]", "x", without_comments(text))
    if text.startswith("\ufeff"):  # no declaration may follow a byte order mark that became a space
        plain = re.sub(r"x(<\?xml.*?\?>)?", lambda match: " " * len(match.group()), plain, count=1)
    parser = expat.ParserCreate("utf-8")
    source = ModelFile(path, text if raw is None else raw, text)
    top = Element(source, "", {}, 0, 0)
    open_elements = [top]

    def start(tag: str, attributes: dict[str, str]) -> None:
        place = parser.CurrentByteIndex
        element = Element(source, tag, attributes, place, _after_tag(plain, place))
        open_elements[-1].children.append(element)
        open_elements.append(element)
        if len(open_elements) > MAX_DEPTH:
            raise ExportError(path, "is nested too deeply", "give a model file")

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
    """Return the position after a tag that begins at another."""
    tag = _TAG.match(text, start)
    return tag.end() if tag else len(text)


def set_value(element: Element, value: str) -> Edit:
    """Return the edit that sets the value of a childless element and keeps its comments."""
    source, start, end = element.source, element.content, element.content_end
    if start == element.end:
        start_tag = source.text[element.start : element.end].rstrip("/>").rstrip()
        return Edit(source, element.start, element.end, f"{start_tag}>{value}</{element.tag}>")
    masked = without_comments(source.text[start:end])
    match = _NUMBER.search(masked)
    if match and match.group() == masked.strip():
        return Edit(source, start + match.start(), start + match.end(), value)
    return Edit(source, start, end, value)


def append_child(parent: Element, tag: str, value: str) -> Edit:
    """Return the edit that adds an element after the last child, with its indentation."""
    child = f"<{tag}>{value}</{tag}>"
    if not parent.children:
        return Edit(parent.source, parent.content, parent.content, child)
    last = parent.children[-1]
    return Edit(parent.source, last.end, last.end, indent_of(last) + child)


def indent_of(element: Element) -> str:
    """Return the line break and space before an element; empty if it does not begin a line."""
    text, start = element.source.raw, element.start
    before = text[text.rfind("\n", 0, start) + 1 : start]
    return "" if before.strip() else "\n" + before


def apply_edits(text: str, edits: Iterable[Edit]) -> str:
    """Return the text with all edits done; they must not overlap."""
    pieces: list[str] = []
    place = 0
    for edit in sorted(edits, key=lambda edit: (edit.start, edit.end)):
        if edit.start < place:
            raise ValueError(f"edits overlap at {edit.start}")
        pieces += (text[place : edit.start], edit.text)
        place = edit.end
    return "".join((*pieces, text[place:]))


_EXPRESSION = re.compile(r"\{\{.*?(?:\}\}|\Z)", re.DOTALL)
_STATEMENT = re.compile(r"\{%.*?(?:%\}|\Z)|\{#.*?(?:#\}|\Z)", re.DOTALL)


def without_jinja(text: str) -> str:
    """Return a text of the same length and lines without Jinja.

    Expressions become letters, which are no numbers; statements and comments become space.
    """
    text = _STATEMENT.sub(lambda match: re.sub(r"[^\n]", " ", match.group()), text)
    return _EXPRESSION.sub(lambda match: re.sub(r"[^\n]", _FILLER, match.group()), text)


def render(text: str, path: Path) -> str:
    """Return a template rendered without variables; a text without Jinja as it is.

    Raises
    ------
    ExportError
        It cannot be rendered, or takes longer than `MAX_RENDERING_S`.
    """
    if not (_EXPRESSION.search(text) or _STATEMENT.search(text)):
        return text
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-c", _RENDER_SCRIPT],
            input=text.encode(),
            capture_output=True,
            timeout=MAX_RENDERING_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise ExportError(path, "takes too long to render", "is it a model?") from None
    if done.returncode:
        last = done.stderr.decode(errors="replace").strip().rpartition("\n")[2] or "out of memory"
        raise ExportError(
            path, f"cannot be rendered without variables ({last[:200]})", "give it defaults"
        )
    return done.stdout.decode()


MAX_RENDERING_S = 20.0
"""A model takes a tenth of a second."""
_RENDER_SCRIPT = """
import sys
try:
    import resource
    resource.setrlimit(resource.RLIMIT_AS, (1 << 30, 1 << 30))
except (ImportError, ValueError, OSError):
    pass  # a system without such limits
from jinja2.sandbox import SandboxedEnvironment
text = sys.stdin.buffer.read().decode()
try:
    text = SandboxedEnvironment(keep_trailing_newline=True).from_string(text).render()
except Exception as error:
    sys.exit(str(error) or type(error).__name__)
if len(text) > 10_000_000:
    sys.exit("it comes to more than 10 MB")
sys.stdout.buffer.write(text.encode())
"""
"""It runs as a process of its own: a template may loop, or multiply its text, without end."""
