"""XML with the place of every element in its text, and edits of the text by place.

Jinja templates of models are read with their expressions blanked out, or rendered. A model that is
split over files is one text, each ``<include merge="true">`` in its place: simulators take what it
names into the model itself. Includes are followed within the folder tree that holds the model's own
folder; what lies elsewhere is left as it stands.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
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

    def find(self, tag: str) -> Element | None:
        """Return the first element of a tag directly inside; None without one."""
        return next((child for child in self.children if child.tag == tag), None)


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
    if not (_EXPRESSION.search(text) or _STATEMENT.search(text)):
        return text
    from jinja2 import TemplateError  # noqa: PLC0415
    from jinja2.sandbox import SandboxedEnvironment  # noqa: PLC0415

    try:
        return SandboxedEnvironment(keep_trailing_newline=True).from_string(text).render()
    except (TemplateError, TypeError, ValueError, ArithmeticError) as error:
        raise ExportError(
            path, f"cannot be rendered without variables ({error})", "give it defaults"
        ) from None


MERGED = "merged__"
"""Tag around what an include was replaced by; its ``at`` is the pose, ``x y z roll pitch yaw``."""
DEEPEST = 8
_NAME = re.compile(r"(?:model://)?([A-Za-z0-9_][A-Za-z0-9._-]{0,99})/?")


@dataclass(frozen=True)
class Piece:
    """A stretch of the whole text that a file holds, from a place on; None is of no file."""

    text: str
    path: Path | None = None
    at: int = 0


@dataclass(frozen=True)
class Whole:
    """A model in one text.

    Attributes
    ----------
    pieces
        The text, in order.
    files
        Every file -> its text as it was read, before it was prepared.
    """

    pieces: tuple[Piece, ...]
    files: Mapping[Path, str]

    @property
    def text(self) -> str:
        """The whole of it, as it was prepared."""
        return "".join(piece.text for piece in self.pieces)

    @property
    def raw(self) -> str:
        """The same as the files have it, if preparing keeps places."""
        return "".join(
            piece.text
            if piece.path is None
            else self.files[piece.path][piece.at : piece.at + len(piece.text)]
            for piece in self.pieces
        )

    def by_file(self, edits: Iterable[Edit]) -> dict[Path, list[Edit]]:
        """Return each file's edits, in its own places, of edits of the whole text."""
        files: dict[Path, list[Edit]] = {}
        for edit in edits:
            path, shift = self._in_file(edit.start, edit.end)
            files.setdefault(path, []).append(Edit(edit.start - shift, edit.end - shift, edit.text))
        return files

    def _in_file(self, start: int, end: int) -> tuple[Path, int]:
        place = 0
        for piece in self.pieces:
            after = place + len(piece.text)
            if piece.path is not None and place <= start and end <= after:
                return piece.path, place - piece.at
            place = after
        raise ValueError(f"{start} to {end} lies in no file")


def assembled(
    path: Path, read: Callable[[Path], str], prepare: Callable[[str, Path], str]
) -> Whole:
    """Return a model with what it includes.

    Parameters
    ----------
    path
        Of the model.
    read
        Returns a file's text.
    prepare
        Text and path -> the XML to take apart.

    Raises
    ------
    ExportError
        A file cannot be read, holds no model, or includes itself.
    """
    files: dict[Path, str] = {}
    return Whole(tuple(_expanded(path, (), files, read, prepare)), files)


def model_in(root: Element, path: Path) -> Element:
    """Return the first ``<model>`` of a file.

    Raises
    ------
    ExportError
        There is none.
    """
    model = root if root.tag == "model" else next(root.all("model"), None)
    if model is None:
        raise ExportError(path, "holds no <model>", "give the SDF of a multirotor")
    return model


def _expanded(
    path: Path,
    above: tuple[Path, ...],
    files: dict[Path, str],
    read: Callable[[Path], str],
    prepare: Callable[[str, Path], str],
) -> list[Piece]:
    """Return a whole file; what it includes is in the place of the include."""
    if path in above or len(above) > DEEPEST:
        raise ExportError(path, "is included in itself", "take the include out")
    files[path] = read(path)
    text = prepare(files[path], path)
    if "<include" not in text:
        return [Piece(text, path)]
    pieces, place = [], 0
    for include in model_in(parse(text, path), path).children:
        source = _source(include, text, path)
        if source is None:
            continue
        inside = _inside_model(_expanded(source, (*above, path), files, read, prepare), source)
        own = prepare(files[source], source)
        at = _pose(include, text, path) or _pose(model_in(parse(own, source), source), own, source)
        pieces += [
            Piece(text[place : include.start], path, place),
            Piece(f'<{MERGED} at="{at or "0 0 0 0 0 0"}">'),
            *inside,
            Piece(f"</{MERGED}>"),
        ]
        place = include.end
    return [*pieces, Piece(text[place:], path, place)]


def _source(include: Element, text: str, path: Path) -> Path | None:
    """Return the file that an element includes and merges; None where that is none of ours."""
    if include.tag != "include" or include.attributes.get("merge") not in ("true", "1"):
        return None
    uri = include.find("uri")
    name = _NAME.fullmatch(content(uri, text)) if uri is not None else None
    if name is None:
        return None
    tree = path.absolute().parent.parent
    source = tree / name.group(1) / "model.sdf"
    inside = source.resolve().is_relative_to(tree.resolve())
    return source if inside and source.is_file() else None


def pose_numbers(element: Element, text: str, path: Path) -> list[float]:
    """Return the six numbers of an element's ``<pose>``; none where it has none.

    Raises
    ------
    ExportError
        They are others.
    """
    pose = element.find("pose")
    words = content(pose, text).split() if pose else []
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = [0.0]
    if len(numbers) not in (0, 6):
        raise ExportError(path, f"has the pose '{' '.join(words)}'", "write six numbers")
    return numbers


def _pose(element: Element, text: str, path: Path) -> str:
    """Return an element's pose as six numbers in text; empty without one."""
    pose, numbers = element.find("pose"), pose_numbers(element, text, path)
    frame = pose.attributes if pose and numbers else {}
    if frame.get("relative_to") or frame.get("degrees") == "true":
        raise ExportError(
            path,
            "includes a model at a pose that is not in radians from its own frame",
            "write it as x y z roll pitch yaw",
        )
    return " ".join(map(repr, numbers))


def _inside_model(pieces: list[Piece], path: Path) -> list[Piece]:
    """Return what of a file lies between the tags of its model."""
    text = "".join(piece.text for piece in pieces)
    model = model_in(parse(text, path), path)
    kept, place = [], 0
    for piece in pieces:
        after = place + len(piece.text)
        low, high = max(place, model.content), min(after, model.content_end)
        if low < high:
            begin, end = low - place, high - place
            kept.append(Piece(piece.text[begin:end], piece.path, piece.at + begin))
        place = after
    return kept
