"""What all configuration models share: field types, unknown keys, errors in one line."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self, TypeVar

from annotated_types import Ge, Gt
from pydantic import AllowInfNan, BaseModel, ConfigDict, Strict, ValidationError, model_validator
from pydantic_core import ErrorDetails, PydanticCustomError

from tuner.config.yaml_file import Document, Place, read_yaml
from tuner.errors import ConfigError, did_you_mean

Number = Annotated[float, Strict(), AllowInfNan(False)]
Positive = Annotated[Number, Gt(0)]
NonNegative = Annotated[Number, Ge(0)]
Whole = Annotated[int, Strict()]
Flag = Annotated[bool, Strict()]
Vector = tuple[Number, Number, Number]


class Section(BaseModel):
    """One mapping of a configuration file: immutable, every key known."""

    model_config: ClassVar[ConfigDict] = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, str_max_length=10_000
    )

    @model_validator(mode="before")
    @classmethod
    def _know_every_key(cls, data: Any) -> Any:
        if data is None:  # a section whose keys are all commented out
            return {}
        if isinstance(data, Mapping):
            for key in data:
                if key not in cls.model_fields:
                    raise PydanticCustomError(
                        "unknown_key",
                        "unknown key",
                        {"key": str(key), "remedy": did_you_mean(str(key), cls.model_fields)},
                    )
        return data

    def replace(self, **changes: object) -> Self:
        """Return a copy with some fields changed, validated again."""
        fields = {name: getattr(self, name) for name in type(self).model_fields}
        return type(self).model_validate(fields | changes)


def refuse(what: str, remedy: str) -> PydanticCustomError:
    """Return the error with which a validator refuses values that do not go together."""
    return PydanticCustomError("refused", "refused", {"what": what, "remedy": remedy})


M = TypeVar("M", bound="Section")


def read_model(kind: type[M], path: str | Path) -> M:
    """Read a YAML file as a model.

    Raises
    ------
    ConfigError
        In one line: the file, the line in it, the key, its value, what it should be.
    """
    document = read_yaml(path)
    try:
        return kind.model_validate(document.data)
    except ValidationError as error:
        raise config_error(error, document) from None


def build(kind: type[M], values: Mapping[str, object], where: str) -> M:
    """Make a model of values that were given elsewhere than in a file, as on the command line.

    Raises
    ------
    ConfigError
        In one line: where, the key, its value, what it should be.
    """
    try:
        return kind.model_validate(values)
    except ValidationError as error:
        raise config_error(error, Document(Path(where), {}, {})) from None


def config_error(error: ValidationError, document: Document) -> ConfigError:
    """Turn the first of pydantic's findings into one line."""
    details = error.errors(include_url=False)
    what, remedy = _sentence(details[0])
    place: Place = details[0]["loc"]
    if details[0]["type"] == "unknown_key":
        place = (*place, details[0]["ctx"]["key"])
    while place and place not in document.lines:
        place = place[:-1]
    line = f"line {document.lines[place]}: " if place in document.lines else ""
    more = f" ({len(details) - 1} more after this)" if len(details) > 1 else ""
    return ConfigError(document.path, line + what, remedy + more)


def _sentence(detail: ErrorDetails) -> tuple[str, str]:
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
            message = detail["msg"].removeprefix("Value error, ")
            return (
                f"{key} is {_short(detail['input'])}",
                message.replace("Input should be", "it should be").replace(
                    "Input should", "it should"
                ),
            )


def dotted(place: Place) -> str:
    """Return ``rotors[0].spin`` for ``("rotors", 0, "spin")``."""
    text = ""
    for part in place:
        text += f"[{part}]" if isinstance(part, int) else f".{part}"
    return text.removeprefix(".")


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
