"""A figure of ``plots/`` as an image inside the page: for paper, and where no script runs."""

from __future__ import annotations

import re
from urllib.parse import quote

PATH = re.compile(r'(?<=\bd=")[^"]*')
"""The data of an SVG path."""
DIGITS = re.compile(r"(\.\d\d)\d+")
"""A decimal fraction: two digits of it are a hundredth of a point, finer than paper shows."""


def data_uri(svg: str) -> str:
    """Return a figure as the address of an image that needs no file.

    Half of a figure is digits that no printer resolves; they are left out here, and kept in
    ``plots/``.
    """
    drawing = PATH.sub(lambda path: " ".join(DIGITS.sub(r"\1", path[0]).split()), svg)
    return "data:image/svg+xml," + quote(drawing, safe=" ,:;=/()")
