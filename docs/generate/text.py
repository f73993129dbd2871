"""Pieces of Markdown that several generated pages share."""

from __future__ import annotations

import types
from typing import Any, Literal, Union, get_args, get_origin

GENERATED = "<!-- Written by `python -m docs.generate`. -->\n\n"
WORDS = {float: "number", int: "whole number", bool: "true or false", str: "text"}


def cell(text: str) -> str:
    """Return text that fits into one cell of a table."""
    return " ".join(text.replace("|", "\\|").replace("``", "`").split())


def type_in_words(hint: Any) -> str:
    """Return what a value of a type looks like in a YAML file; empty where a section says it."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Literal:
        return " ".join(f"`{value}`" for value in arguments)
    if origin in (Union, types.UnionType):
        parts = [type_in_words(part) for part in arguments if part is not type(None)]
        return ", ".join(dict.fromkeys(filter(None, parts)))
    if origin is tuple:
        inner = type_in_words(arguments[0])
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            return f"list of {inner}" if inner else "list"
        return f"{len(arguments)} × {inner}"
    if hasattr(hint, "__metadata__"):
        return type_in_words(arguments[0])
    return WORDS.get(hint, "path" if getattr(hint, "__name__", "") == "Path" else "")
