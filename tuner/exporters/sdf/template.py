"""Jinja templates of models: read as XML with their expressions blanked out, and rendered."""

from __future__ import annotations

import re
from pathlib import Path

from tuner.core.errors import ExportError

_EXPRESSION = re.compile(r"\{\{.*?\}\}", re.DOTALL)
_STATEMENT = re.compile(r"\{%.*?%\}|\{#.*?#\}", re.DOTALL)
_FILLER = "J"


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
