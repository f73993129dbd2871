"""The first of pydantic's complaints as one line: the key, its value, what it should be."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from tuner.core.errors import ConfigError

Place = tuple[str | int, ...]


def config_error(
    error: ValidationError, path: Path, lines: Mapping[Place, int] | None = None
) -> ConfigError:
    """Return the first complaint as one line.

    Parameters
    ----------
    lines
        Place of a value in the file -> its line, where lines are known.
    """
    lines = lines or {}
    details = error.errors(include_url=False)
    what, remedy = first_complaint(details)
    place: Place = details[0]["loc"]
    if details[0]["type"] == "unknown_key":
        place = (*place, details[0]["ctx"]["key"])
    while place and place not in lines:
        place = place[:-1]
    line = f"line {lines[place]}: " if place in lines else ""
    more = f" ({len(details) - 1} more after this)" if len(details) > 1 else ""
    return ConfigError(path, line + what, remedy + more)


_EXPECTATIONS: Mapping[str, str] = {
    "bool_type": "it should be true or false",
    "dict_type": "it should be a mapping of keys to values",
    "finite_number": "it should be a finite number",
    "float_type": "it should be a number",
    "greater_than": "it should be more than {gt}",
    "greater_than_equal": "it should be at least {ge}",
    "int_type": "it should be a whole number",
    "is_instance_of": "it should be a mapping of keys to values",
    "json_type": "it should be what JSON can hold",
    "less_than": "it should be less than {lt}",
    "less_than_equal": "it should be at most {le}",
    "list_type": "it should be a list",
    "literal_error": "it should be {expected}",
    "model_type": "it should be a mapping of keys to values",
    "none_required": "it should be left out",
    "path_type": "it should be the name of a file",
    "string_too_long": "it should have at most {max_length} characters",
    "string_too_short": "it should have at least {min_length} characters",
    "string_type": "it should be text",
    "string_unicode": "it should be text in UTF-8",
    "too_long": "it should have at most {max_length} entries",
    "too_short": "it should have at least {min_length} entries",
    "tuple_type": "it should be a list",
    "union_tag_invalid": "its {discriminator} should be one of {expected_tags}",
    "union_tag_not_found": "it should have a key {discriminator}",
}
"""Type of a complaint -> what the value should have been, by the complaint's context."""
_SAME_KINDS: Mapping[str, str] = {
    "bool_parsing": "bool_type",
    "enum": "literal_error",
    "float_parsing": "float_type",
    "int_from_float": "int_type",
    "invalid-json-value": "json_type",
    "int_parsing": "int_type",
    "int_parsing_size": "int_type",
    "iterable_type": "list_type",
    "mapping_type": "dict_type",
    "model_attributes_type": "model_type",
}
PATTERN_PHRASES: Mapping[str, str] = {
    "^[0-9a-f]{64}$": "it should be a recording's id: 64 digits 0-9 and a-f, as uploaded",
    "^[!-~]+$": "it should be printable ASCII without blanks",
    r"^[0-9]+(\.[0-9]+)? ?[KMGT]i?B$": "it should be a size, as 4 GiB",
    r"^(tcp|tls|ws|wss|ucx)://[^\s/]+:[0-9]{1,5}/?$": "it should be an address, as tcp://host:8786",
}
"""Pattern that a key's text has to match -> the same for people."""


def first_complaint(details: Sequence[ErrorDetails], whole: str = "the file") -> tuple[str, str]:
    """Return the first error, and its remedy; ``whole`` is what holds all keys.

    Where a key takes values of several kinds, each kind complains: what goes deepest into the value
    has understood it best, and what goes equally deep is told as one.
    """
    place = _keys(details[0]["loc"])
    if place == details[0]["loc"]:
        return complaint(details[0], whole)
    rivals = [detail for detail in details if _keys(detail["loc"])[: len(place)] == place]
    depth = max(len(_keys(detail["loc"])) for detail in rivals)
    deepest = [detail for detail in rivals if len(_keys(detail["loc"])) == depth]
    what, remedy = complaint(deepest[0], whole)
    others = dict.fromkeys(complaint(detail, whole) for detail in deepest[1:])
    more = [words for other, words in others if other == what and words != remedy]
    return what, ", or ".join([remedy, *(words.removeprefix("it should be ") for words in more)])


def complaint(detail: ErrorDetails, whole: str = "the file") -> tuple[str, str]:
    """Return a pydantic complaint in plain words, and its remedy."""
    place = _keys(detail["loc"])
    key = dotted(place) or whole
    context = detail.get("ctx", {})
    match detail["type"]:
        case "unknown_key":
            return f"unknown key '{dotted((*place, context['key']))}'", context["remedy"]
        case "refused":
            return context["what"], context["remedy"]
        case "missing":
            return (f"key '{key}' is missing" if place else f"{whole} is missing"), "add it"
        case _:
            text = repr(detail["input"])
            shown = text if len(text) <= 60 else text[:57] + "..."
            return f"{key} is {shown}", expected(detail["type"], context)


def expected(kind: str, context: Mapping[str, Any]) -> str:
    """Return the expected value, by the type and the context of a complaint."""
    if kind == "value_error":
        return str(context["error"])
    if kind == "string_pattern_mismatch":
        return PATTERN_PHRASES.get(context["pattern"], OTHER_FORM)
    words = _EXPECTATIONS.get(_SAME_KINDS.get(kind, kind))
    return OTHER_FORM if words is None else words.format_map(context)


OTHER_FORM = "it should be of another form; see the reference of its key"


_KIND = re.compile(
    r"(literal|tuple|list|dict|set|union|tagged-union|nullable|function-\w+|constrained-\w+|"
    r"json-or-python|lax-or-strict|is-instance)\[.*|constrained-\w+|str|int|float|bool|none|path|"
    r"VehicleFile|ControllerFile|TopicMap|\[key\]",
    re.DOTALL,
)
"""Parts of pydantic's locations that are no keys: kinds of values."""


def _keys(place: Place) -> Place:
    return tuple(part for part in place if isinstance(part, int) or not _KIND.fullmatch(part))


def dotted(place: Place) -> str:
    """Return ``rotors[0].spin`` for ``("rotors", 0, "spin")``."""
    text = ""
    for part in place:
        text += f"[{part}]" if isinstance(part, int) else f".{part}"
    return text.removeprefix(".")
