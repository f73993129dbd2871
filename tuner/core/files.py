"""JSON, CSV and arrays of a result folder: JSON is read with a limit and a schema version."""

from __future__ import annotations

import csv
import io
import json
import math
import zlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self
from zipfile import BadZipFile, is_zipfile

from pydantic import AfterValidator, BaseModel, ConfigDict, ValidationError

from tuner.core.disk import open_file, read_bytes, write_text
from tuner.core.errors import InputError
from tuner.core.phrases import printable
from tuner.core.yaml_section import config_error

if TYPE_CHECKING:
    from numpy.typing import NDArray

MAX_BYTES = 50_000_000
"""The limit of a JSON file in a result folder."""
MAX_ARRAYS = 1 << 28
"""Bytes of all arrays of a file together, unpacked."""


def csv_text(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return CSV text, numbers in full precision and nothing for None.

    A word that a spreadsheet would compute, as the name of a recording may be, gets an apostrophe.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([_cell(value) for value in row] for row in (header, *rows))
    return text.getvalue()


def _cell(value: object) -> object:
    if isinstance(value, str):
        shown = printable(value)
        return f"'{shown}" if shown.lstrip().startswith(("=", "+", "-", "@")) else shown
    return repr(value) if isinstance(value, float) else value


def read_arrays(path: Path, *, remedy: str) -> dict[str, NDArray[Any]]:
    """Return the arrays of an ``.npz`` file by their names.

    Raises
    ------
    InputError
        The file cannot be read, is damaged or holds too much; ``remedy`` says what to do.
    """
    import numpy as np  # noqa: PLC0415 (`tune --help` answers without it)

    try:
        with open_file(path) as file:
            if not is_zipfile(file):
                raise ValueError("it is no archive")
            file.seek(0)
            with np.load(file, allow_pickle=False) as data:
                size = sum(part.file_size for part in data.zip.infolist())
                if size > MAX_ARRAYS:
                    raise ValueError(f"it unpacks to {size} bytes")
                return {name: data[name] for name in data.files}
    except (EOFError, MemoryError, AttributeError) as error:
        raise InputError(path, f"is damaged ({type(error).__name__})", remedy) from None
    except (OSError, BadZipFile, ValueError, TypeError, RuntimeError, zlib.error) as error:
        raise InputError(path, f"is damaged ({error})", remedy) from None


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        twice = next(key for key, _ in pairs if [k for k, _ in pairs].count(key) > 1)
        raise ValueError(f"it has the key {twice!r} twice")
    return content


def _finite(number: str) -> float:
    value = float(number)
    if not math.isfinite(value):
        raise ValueError(f"it holds {number[:20]}, which is no finite number")
    return int(number) if number.lstrip("-").isdigit() else value


class Part(BaseModel):
    """A part of a JSON file of a result folder; unknown keys are ignored."""

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="ignore")


FiniteOrNone = Annotated[
    float | None, AfterValidator(lambda v: v if v is not None and math.isfinite(v) else None)
]
"""A number for a JSON file, which has none for infinity and not-a-number: those are None."""


class ResultFile(Part):
    """The whole of a JSON file of a result folder.

    The default of ``schema_version`` is the version that this program writes, and the only one that
    it reads.
    """

    FILE: ClassVar[str]
    INDENT: ClassVar[int | None] = 1

    schema_version: int = 1

    def write(self, folder: Path) -> None:
        """Write the file, which appears whole, into a result folder.

        Raises
        ------
        OutputError
            It cannot be written there.
        """
        write_text(folder / self.FILE, self.model_dump_json(indent=self.INDENT) + "\n")

    @classmethod
    def read_if_any(cls, folder: Path) -> Self | None:
        """Read the file of a result folder as `read` does; None where there is none."""
        return cls.read(folder) if (folder / cls.FILE).exists() else None

    @classmethod
    def read(
        cls,
        folder: Path,
        remedy: str = "run tune again, or use the tune that wrote this folder",
    ) -> Self:
        """Read the file of a result folder.

        Raises
        ------
        InputError
            The file is missing, cannot be read, is too large, is of another schema version or of
            none, or lacks a key; ``remedy`` says what to do.
        """
        path = folder / cls.FILE
        raw = read_bytes(path, most=MAX_BYTES, remedy=remedy)
        try:
            content = json.loads(
                raw,
                object_pairs_hook=_once,
                parse_int=_finite,
                parse_float=_finite,
                parse_constant=_finite,
            )
        except RecursionError:
            raise InputError(path, "is nested too deeply", remedy) from None
        except ValueError as error:
            raise InputError(path, f"is not JSON ({error})", remedy) from None
        version = cls.model_fields["schema_version"].default
        of_file = content.get("schema_version") if isinstance(content, dict) else None
        if of_file != version:
            what = "has no schema version" if of_file is None else f"has schema version {of_file}"
            raise InputError(path, f"{what}, and this tune reads version {version}", remedy)
        try:
            return cls.model_validate_json(raw, strict=True)
        except ValidationError as error:
            wrong = config_error(error, path)
            raise InputError(path, wrong.what, wrong.remedy) from None
