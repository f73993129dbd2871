"""Base of all configuration models: field types, unknown keys, errors in one line."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import MISSING, fields
from pathlib import Path
from types import UnionType
from typing import (
    Annotated,
    Any,
    ClassVar,
    Self,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from annotated_types import Ge, Gt
from pydantic import (
    AllowInfNan,
    BaseModel,
    ConfigDict,
    Strict,
    ValidationError,
    create_model,
    model_validator,
)
from pydantic_core import PydanticCustomError

from tuner.core.errors import did_you_mean
from tuner.core.validation import config_error
from tuner.core.yaml_document import read_yaml

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
        raise config_error(error, document.path, document.lines) from None


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
        raise config_error(error, Path(where)) from None


def section_of(options: type, *, leaving: Collection[str] = (), text: Any = str) -> type[Section]:
    """Return a model that checks the fields of a dataclass.

    Parameters
    ----------
    text
        What stands for ``str``, as a shorter text.
    """
    hints = get_type_hints(options, include_extras=True)
    chosen = {
        field.name: (
            _checked(hints[field.name], text),
            ... if field.default is MISSING else field.default,
        )
        for field in fields(options)
        if field.name not in leaving
    }
    return create_model(options.__name__, __base__=Section, **chosen)  # type: ignore[call-overload, no-any-return]


def _checked(hint: Any, text: Any) -> Any:
    """Return a type of which no value of another type is made."""
    if hint is str:
        return text
    if hint in (bool, int, float):
        return Annotated[hint, Strict()]
    inner = [_checked(part, text) for part in get_args(hint)]
    if get_origin(hint) is Annotated:
        return Annotated[_checked(get_args(hint)[0], text), *hint.__metadata__]
    if get_origin(hint) in (Union, UnionType):
        return Union[*inner]
    return tuple.__class_getitem__((inner[0], ...)) if get_origin(hint) is Sequence else hint
