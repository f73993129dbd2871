"""JSON, CSV and arrays of a result folder: JSON is read with a limit and a schema version."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar
from zipfile import BadZipFile

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import from_json

from tuner.errors import ConfigError, InputError
from tuner.validation import config_error

if TYPE_CHECKING:
    from numpy.typing import NDArray

MAX_BYTES = 50_000_000
"""Of a JSON file of a result folder."""


def csv_text(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return CSV text, numbers in full precision and nothing for None."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    for row in rows:
        writer.writerow(["" if v is None else repr(v) if isinstance(v, float) else v for v in row])
    return text.getvalue()


def read_bytes(path: Path, *, most: int, remedy: str) -> bytes:
    """Return the content of a file, if it holds no more than so many bytes.

    Raises
    ------
    ConfigError
        The file does not exist, cannot be read or is larger; ``remedy`` says what to do.
    """
    try:
        with path.open("rb") as file:
            raw = file.read(most + 1)
    except (FileNotFoundError, NotADirectoryError):
        raise ConfigError(path, "does not exist", remedy) from None
    except OSError as error:
        raise ConfigError(path, f"cannot be read ({error.strerror})", remedy) from None
    if len(raw) > most:
        raise ConfigError(path, f"is larger than {most // 1_000_000} MB", remedy)
    return raw


def read_arrays(path: Path, *, remedy: str) -> dict[str, NDArray[Any]]:
    """Return the arrays of an ``.npz`` file by their names.

    Raises
    ------
    InputError
        The file cannot be read or is damaged; ``remedy`` says what to do.
    """
    import numpy as np  # noqa: PLC0415 (`tune --help` answers without it)

    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
            return {name: data[name] for name in data.files}
    except (OSError, EOFError, BadZipFile, ValueError, TypeError, AttributeError) as error:
        raise InputError(path, f"is damaged ({error})", remedy) from None


class Part(BaseModel):
    """A part of a JSON file of a result folder; unknown keys are ignored."""

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="ignore")


P = TypeVar("P", bound=Part)


def read_json(kind: type[P], path: Path, *, version: int, remedy: str) -> P:
    """Read a JSON file whose ``schema_version`` is the one that this program writes.

    Parameters
    ----------
    kind
        The model of the file's content.
    path
        The file.
    version
        The only version that is read; a file without ``schema_version`` is refused.
    remedy
        What to do about a file that is missing, cannot be read or is of another version.

    Raises
    ------
    InputError
        The file cannot be read, is too large, is of another version, or lacks a key.
    """
    raw = read_bytes(path, most=MAX_BYTES, remedy=remedy)
    try:
        content = from_json(raw)
    except ValueError as error:
        raise InputError(path, f"is not JSON ({error})", remedy) from None
    file_version = content.get("schema_version") if isinstance(content, dict) else None
    if file_version != version:
        what = (
            "has no schema version"
            if file_version is None
            else f"has schema version {file_version}"
        )
        raise InputError(path, f"{what}, and this tune reads version {version}", remedy)
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        wrong = config_error(error, path)
        raise InputError(path, wrong.what, wrong.remedy) from None


def read_optional(kind: type[P], path: Path, *, version: int = 1) -> P | None:
    """Read a JSON file of a result folder as `read_json` does; None where there is none."""
    if not path.exists():
        return None
    return read_json(
        kind, path, version=version, remedy="run tune again, or use the tune that wrote this folder"
    )
