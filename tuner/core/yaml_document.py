"""YAML in and out: bounded, without duplicate keys, with the line of every key at hand."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml

from tuner.core.disk import exists
from tuner.core.errors import ConfigError
from tuner.core.files import read_bytes
from tuner.core.phrases import printable
from tuner.core.validation import Place

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
