"""The sections of a configuration file as tables, from the models that read it."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from typing import Any, get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from docs.generate.text import cell, type_in_words

_CROSS_REFERENCE = re.compile(r"(?<!`)`([A-Z]\w+)`(?!`)")


def sections_of(model: type) -> str:
    """Return one heading and table a section of a file, the whole file's first."""
    whole, *parts = _with_parts(model, [])
    sections = [_section("Keys", whole), *(_section(_title(part), part) for part in parts)]
    return "\n".join(sections)


def _with_parts(model: Any, seen: list[type[BaseModel]]) -> list[type[BaseModel]]:
    """Return a model and, depth first, those of its fields; each once."""
    if model not in seen:
        seen.append(model)
        for field in model.model_fields.values():
            for part in _models_in(field.annotation):
                _with_parts(part, seen)
    return seen


def _models_in(hint: Any) -> Iterator[type[BaseModel]]:
    if inspect.isclass(hint) and issubclass(hint, BaseModel):
        yield hint
    for part in get_args(hint):
        yield from _models_in(part)


def _section(title: str, model: type[BaseModel]) -> str:
    text, meanings = _documented(model)
    rows = [
        f"| `{name}` | {_values(field)} | {_default(field)} | {cell(meanings.get(name, ''))} |"
        for name, field in model.model_fields.items()
    ]
    table = "\n".join(["| key | value | default | meaning |", "| --- | --- | --- | --- |", *rows])
    return f"## {title}\n\n{text}\n\n{table}\n"


def _title(model: type[BaseModel]) -> str:
    """Return a class's name as words: `RpmCurve` is the RPM curve."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", model.__name__).capitalize()


def _documented(model: type[BaseModel]) -> tuple[str, dict[str, str]]:
    """Return a class's text, and attribute -> meaning of its docstring's list."""
    text = _CROSS_REFERENCE.sub(_linked, inspect.getdoc(model) or "")
    text, _, attributes = text.partition("Attributes\n----------\n")
    meanings: dict[str, str] = {}
    names: list[str] = []
    for line in attributes.splitlines():
        if line and not line.startswith(" "):
            names = [name.strip() for name in line.split(",")]
        else:
            for name in names:
                meanings[name] = f"{meanings.get(name, '')} {line.strip()}".strip()
    return text.strip().replace("``", "`"), meanings


def _linked(match: re.Match[str]) -> str:
    words = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", match[1]).lower()
    return f"*{words}*"


def _values(field: FieldInfo) -> str:
    """Return what may stand there: a type, or where the parts of a section are listed."""
    links = [f"[{t}](#{t.lower().replace(' ', '-')})" for t in _titles(field.annotation)]
    return " ".join(links) or cell(type_in_words(field.annotation))


def _titles(hint: Any) -> list[str]:
    return list(dict.fromkeys(_title(part) for part in _models_in(hint)))


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    default = field.get_default(call_default_factory=True)
    if default is None or isinstance(default, BaseModel) or default in ((), {}, ""):
        return ""
    if isinstance(default, tuple):
        return f"`[{', '.join(map(str, default))}]`"
    return f"`{str(default).lower() if isinstance(default, bool) else default}`"
