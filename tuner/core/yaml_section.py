"""YAML files as models: places and lines, field types, unknown keys, errors in one line."""

from __future__ import annotations

import io
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
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

import yaml
from annotated_types import Ge, Gt
from pydantic import (
    AllowInfNan,
    BaseModel,
    ConfigDict,
    InstanceOf,
    Strict,
    ValidationError,
    create_model,
    model_validator,
)
from pydantic_core import ErrorDetails, PydanticCustomError

from tuner.core.disk import exists, read_bytes
from tuner.core.errors import ConfigError, did_you_mean
from tuner.core.phrases import printable

MAX_BYTES = 1_000_000
MAX_NODES = 100_000
MAX_DIGITS = 4000
"""Python refuses an integer of more than 4300."""


@dataclass(frozen=True)
class Document:
    """The content of a YAML file.

    Attributes
    ----------
    data
        Plain dicts, lists, strings, numbers, booleans and None.
    lines
        Place of a value, such as ``("rotors", 0, "spin")``, to its line in the file, from 1.
    """

    path: Path
    data: object
    lines: Mapping[Place, int]


class _Loader(yaml.SafeLoader):
    """YAML 1.2's core schema: ``1e-6`` is a number; ``no``, ``1:30`` and dates are words."""


class _Dumper(yaml.SafeDumper):
    """Writes what `_Loader` reads back as the same values."""

    def ignore_aliases(self, data: object) -> bool:  # noqa: ARG002
        return True


_CORE_SCHEMA = (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9]+", list("-+0123456789")),
    (
        "float",
        r"[-+]?(?:(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|\.(?i:inf))|\.(?i:nan)",
        list("-+.0123456789"),
    ),
)
_Loader.yaml_implicit_resolvers = {}
for _tag, _pattern, _first in _CORE_SCHEMA:
    for _class in (_Loader, _Dumper):
        _class.add_implicit_resolver(
            f"tag:yaml.org,2002:{_tag}", re.compile(f"^(?:{_pattern})$"), _first
        )


def _decimal(loader: yaml.SafeLoader, node: yaml.ScalarNode) -> int:
    digits = str(loader.construct_scalar(node))
    if len(digits) > MAX_DIGITS:
        what = f"a number has {len(digits)} digits"
        raise yaml.constructor.ConstructorError(None, None, what, node.start_mark)
    return int(digits)


_Loader.add_constructor("tag:yaml.org,2002:int", _decimal)


def read_yaml(path: str | Path) -> Document:
    """Read a file of one YAML document.

    Raises
    ------
    ConfigError
        The file is missing or too large, or as of `document_of`.
    """
    path = Path(path)
    if exists(path) and path.is_dir():
        raise ConfigError(path, "is a folder", "give the path of a YAML file")
    raw = read_bytes(path, most=MAX_BYTES, remedy="give the path of a YAML file")
    return document_of(raw, path)


def document_of(raw: bytes, path: Path) -> Document:
    """Return one YAML document, of a file or what messages call one.

    Raises
    ------
    ConfigError
        It is not YAML, has a key twice, or is too long once its aliases are written out.
    """
    try:
        loader = _Loader(raw.decode("utf-8-sig"))
        node = loader.get_single_node()
        if node is None:
            return Document(path, {}, {})
        lines: dict[Place, int] = {}
        _check(path, node, (), lines, ())
        if _length(node) > MAX_BYTES:  # aliases repeat a long word
            raise ConfigError(path, "holds more than 1 MB of text", "write short values out")
        return Document(path, loader.construct_document(node), lines)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        at = f"line {mark.line + 1}: " if mark else ""
        raise ConfigError(
            path, f"{at}{error.problem or error.context}", "correct the YAML"
        ) from None
    except UnicodeDecodeError:
        raise ConfigError(path, "is not UTF-8 text", "give a YAML file") from None
    except (yaml.YAMLError, ValueError) as error:
        raise ConfigError(path, f"is not YAML ({error})", "correct the file") from None
    except RecursionError:
        raise ConfigError(path, "is nested too deeply", "give a plain configuration file") from None


def commented(text: str) -> str:
    """Return lines of text as comment lines, which a terminal or a parser may read."""
    return "".join(f"# {printable(line)}".rstrip() + "\n" for line in text.splitlines())


def dump_yaml(data: object) -> str:
    """Return a document as YAML text, floats by their repr."""
    root = _Dumper(io.StringIO(), sort_keys=False).represent_data(data)
    _set_style(root, depth=0)
    return str(yaml.serialize(root, Dumper=_Dumper, allow_unicode=True, width=1000))


def _set_style(node: yaml.Node, depth: int) -> None:
    """Give the file and its sections a line for each key, and what lies deeper one line."""
    if isinstance(node, yaml.MappingNode | yaml.SequenceNode):
        node.flow_style = depth > 1
    elif isinstance(node, yaml.ScalarNode) and set(node.value) & set("\x85\u2028\u2029"):
        node.style = '"'  # which escapes line breaks that a plain word would lose
    for child in _children(node):
        _set_style(child, depth + 1)


def _children(node: yaml.Node) -> list[yaml.Node]:
    if isinstance(node, yaml.MappingNode):
        return [child for pair in node.value for child in pair]
    return list(node.value) if isinstance(node, yaml.SequenceNode) else []


def _length(node: yaml.Node) -> int:
    """Return the number of characters of all keys and values, aliases written out."""
    return sum(map(_length, _children(node))) or len(node.value)


def _check(
    path: Path, node: yaml.Node, place: Place, lines: dict[Place, int], above: Sequence[yaml.Node]
) -> None:
    """Refuse keys that are no words or stand twice, and endless aliases; note each value's line."""
    if any(node is one for one in above):
        raise ConfigError(path, "has an alias inside its own anchor", "write the values out")
    if len(lines) > MAX_NODES:
        raise ConfigError(path, f"holds more than {MAX_NODES} values", "give a configuration file")
    lines[place] = node.start_mark.line + 1
    inside = (*above, node)
    if isinstance(node, yaml.SequenceNode):
        for index, child in enumerate(node.value):
            _check(path, child, (*place, index), lines, inside)
    if not isinstance(node, yaml.MappingNode):
        return
    seen: dict[str, int] = {}
    for key, child in node.value:
        line = key.start_mark.line + 1
        if not isinstance(key, yaml.ScalarNode):
            raise ConfigError(path, f"line {line}: a key is not a word", "correct the YAML")
        if key.value in seen:
            what = f"line {line}: key '{key.value}' already stands in line {seen[key.value]}"
            raise ConfigError(path, what, "keep one of them")
        seen[key.value] = line
        _check(path, child, (*place, key.value), lines, inside)
        lines[*place, key.value] = line


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
    first = _keys(details[0]["loc"])
    others = sum(_keys(detail["loc"])[: len(first)] != first for detail in details)
    more = f" ({others} more after this)" if others else ""
    return ConfigError(path, line + what, remedy + more)


_EXPECTATIONS: Mapping[str, str] = {
    "bool_type": "it should be true or false",
    "dict_type": "it should be a mapping of keys to values",
    "finite_number": "it should be a finite number",
    "float_type": "it should be a number",
    "greater_than": "it should be more than {gt}",
    "greater_than_equal": "it should be at least {ge}",
    "int_type": "it should be a whole number",
    "is_instance_of": "it should be a {class}",
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
    """Return the keys in a location, whose first part is always one."""
    inner = (part for part in place[1:] if isinstance(part, int) or not _KIND.fullmatch(part))
    return (*place[:1], *inner)


def dotted(place: Place) -> str:
    """Return ``rotors[0].spin`` for ``("rotors", 0, "spin")``."""
    text = ""
    for part in place:
        text += f"[{part}]" if isinstance(part, int) else f".{part}"
    return text.removeprefix(".")


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


def build_options(kind: type[M], values: Mapping[str, object]) -> M:
    """Make a model of options, as `build` does.

    Raises
    ------
    ConfigError
        In one line: the option, its value, what it should be.
    """
    try:
        return kind.model_validate(values)
    except ValidationError as error:
        details = error.errors(include_url=False)
        what, remedy = first_complaint(details)
        place = tuple(str(key) for key in _keys(details[0]["loc"]))
        option = place[0] if place[-1] == "name" else place[-1]
        words = what.removeprefix(f"{dotted(place)} ")
        where = f"--{option.rstrip('_').replace('_', '-')}"
        raise ConfigError(where, words, remedy) from None


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


Text = Annotated[str, Strict()]
"""Text that is not made of bytes."""


def check_types(values: Mapping[str, object], hints: Mapping[str, Any], where: str) -> None:
    """Refuse a value that is of no type of its hint.

    Raises
    ------
    ConfigError
        In one line: where, the value's name, the value, what it should be.
    """
    own: dict[str, Any] = {name: (_checked(hints[name], Text), ...) for name in values}
    build(create_model("values", __base__=Section, **own), values, where)


def _checked(hint: Any, text: Any) -> Any:
    """Return a type of which no value of another type is made."""
    plain, kind = {str: text, Mapping: dict[Any, Any]}, get_origin(hint) or hint
    if kind in plain:
        return plain[kind]
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        instance: Any = InstanceOf  # an alias to mypy, which takes no type that is computed
        return instance[kind]
    if hint in (bool, int, float):
        return Annotated[hint, Strict()]
    inner = [_checked(part, text) for part in get_args(hint)]
    if get_origin(hint) is Annotated:
        return Annotated[_checked(get_args(hint)[0], text), *hint.__metadata__]
    if get_origin(hint) in (Union, UnionType):
        return Union[*inner]
    return tuple.__class_getitem__((inner[0], ...)) if get_origin(hint) is Sequence else hint
