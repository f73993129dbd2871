"""The first of pydantic's complaints as one line: the key, its value, what it should be."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from tuner.errors import ConfigError

Place = tuple[str | int, ...]


def config_error(
    error: ValidationError, path: Path, lines: Mapping[Place, int] | None = None
) -> ConfigError:
    """Return the first complaint as one line.

    Parameters
    ----------
    error
        From validating what a file holds.
    path
        The file.
    lines
        Place of a value in the file -> its line, where lines are known.
    """
    lines = lines or {}
    details = error.errors(include_url=False)
    what, remedy = complaint(details[0])
    place: Place = details[0]["loc"]
    if details[0]["type"] == "unknown_key":
        place = (*place, details[0]["ctx"]["key"])
    while place and place not in lines:
        place = place[:-1]
    line = f"line {lines[place]}: " if place in lines else ""
    more = f" ({len(details) - 1} more after this)" if len(details) > 1 else ""
    return ConfigError(path, line + what, remedy + more)


def complaint(detail: ErrorDetails) -> tuple[str, str]:
    """Return what one of pydantic's complaints says is wrong, and what to do about it."""
    key = dotted(detail["loc"]) or "the file"
    context = detail.get("ctx", {})
    match detail["type"]:
        case "unknown_key":
            return f"unknown key '{dotted((*detail['loc'], context['key']))}'", context["remedy"]
        case "refused":
            return context["what"], context["remedy"]
        case "missing":
            return f"key '{key}' is missing", "add it"
        case "model_type" | "model_attributes_type" | "dict_type":
            return f"{key} is {_short(detail['input'])}", "it should be a mapping of keys to values"
        case _:
            return f"{key} is {_short(detail['input'])}", _expected(detail)


def _expected(detail: ErrorDetails) -> str:
    """Return what a value should have been."""
    context = detail.get("ctx", {})
    match detail["type"]:
        case "too_short" | "string_too_short":
            return f"give at least {context['min_length']}"
        case "too_long" | "string_too_long":
            return f"give at most {context['max_length']}"
        case "string_pattern_mismatch":
            return f"it should look like {context['pattern']}"
        case _:
            message = detail["msg"].removeprefix("Value error, ")
            message = message.replace("Input should be", "it should be")
            return message.replace("Input should", "it should")


def dotted(place: Place) -> str:
    """Return ``rotors[0].spin`` for ``("rotors", 0, "spin")``."""
    text = ""
    for part in place:
        text += f"[{part}]" if isinstance(part, int) else f".{part}"
    return text.removeprefix(".")


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
