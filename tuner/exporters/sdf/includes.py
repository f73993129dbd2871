"""A model that is split over files, as one text: each ``<include merge="true">`` in its place.

Simulators take what such an include names into the model itself. Includes are followed within the
folder tree that holds the model's own folder; what lies elsewhere is left as it stands.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from tuner.core.errors import ExportError
from tuner.exporters.sdf.spans import Edit, Element, content, parse

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

    def path_at(self, place: int) -> Path:
        """Return the file that a place of the whole text lies in."""
        path, _ = self._in_file(place, place)
        return path

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
        at = _pose(include, text, path) or _pose_of_model(files[source], source, prepare)
        pieces += [
            Piece(text[place : include.start], path, place),
            Piece(f'<{MERGED} at="{at}">'),
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


def _pose(element: Element, text: str, path: Path) -> str:
    """Return an element's pose as six numbers in text; empty without one."""
    pose = element.find("pose")
    words = content(pose, text).split() if pose else []
    if pose is None or not words:
        return ""
    if pose.attributes.get("relative_to") or pose.attributes.get("degrees") == "true":
        raise ExportError(
            path,
            "includes a model at a pose that is not in radians from its own frame",
            "write it as x y z roll pitch yaw",
        )
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) != 6:
        raise ExportError(path, f"has the pose '{' '.join(words)}'", "write six numbers")
    return " ".join(map(repr, numbers))


def _pose_of_model(text: str, path: Path, prepare: Callable[[str, Path], str]) -> str:
    prepared = prepare(text, path)
    model = model_in(parse(prepared, path), path)
    return _pose(model, prepared, path) or "0 0 0 0 0 0"


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
