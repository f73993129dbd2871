"""Tables: CSV and Parquet, one row a time, one column a number."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tuner.errors import RecordingError
from tuner.flights.damage import Cause, Damage
from tuner.flights.flight import Array
from tuner.flights.notes import Note, NoteCode
from tuner.flights.recording import (
    NANOSECONDS,
    ROWS,
    Clock,
    Contents,
    Nanoseconds,
    Request,
    Samples,
    TabularRecording,
)

if TYPE_CHECKING:
    import pyarrow

#: A longer line, in bytes, is no row of a table.
LONGEST_LINE = 1 << 20
#: Tables with more columns or cells are no flight.
MOST_COLUMNS = 10_000
MOST_CELLS = 500_000_000


class Table(TabularRecording):
    """A CSV or Parquet file with a line of column names.

    Raises
    ------
    RecordingError
        It is no table.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._skipped = 0
        with path.open("rb") as stream:
            self._parquet = stream.read(4) == b"PAR1"
        columns = self._parquet_columns() if self._parquet else self._csv_columns()
        if len(set(columns)) < 2 or len(columns) > MOST_COLUMNS:
            raise RecordingError(
                path, f"{len(columns)} columns are no table of a flight", "check its first line"
            )
        super().__init__(path, "table", columns)

    def read(self, wanted: Mapping[str, Request]) -> Contents:
        """Read the wanted columns."""
        if ROWS not in wanted:
            return Contents({})
        request = wanted[ROWS]
        clock = self.clock(request)
        names = list(dict.fromkeys([clock.field, *request.fields]))
        table = self._read(names)
        time = _nanoseconds(table.column(clock.field), clock)
        fields = {name: _numbers(table.column(name)) for name in request.fields}
        notes = []
        damage = [Damage(Cause.ROWS_MALFORMED, lost=self._skipped)] if self._skipped else []
        kept = time != _NEVER
        if not kept.all():
            lost = int((~kept).sum())
            notes.append(Note(NoteCode.ROWS_WITHOUT_TIME, topic=ROWS, count=lost))
        fields = {name: values[kept] for name, values in fields.items()}
        samples = Samples(time[kept], time[kept], fields)
        return Contents({ROWS: samples}, tuple(notes), tuple(damage))

    def _csv_columns(self) -> list[str]:
        with self.path.open("rb") as stream:
            self._before = 0
            line = stream.readline(LONGEST_LINE)
            while line.startswith(b"#") and self._before < 1000:
                self._before += 1
                line = stream.readline(LONGEST_LINE)
        text = line.decode(errors="replace").lstrip("\ufeff").rstrip("\r\n")
        self._separator = max(",;\t", key=text.count)
        return [name.strip().strip('"') for name in text.split(self._separator)]

    def _parquet_columns(self) -> list[str]:
        from pyarrow import ArrowException, parquet  # noqa: PLC0415 (a third of a second)

        try:
            with parquet.ParquetFile(self.path) as file:
                about = file.metadata
                if about.num_rows * about.num_columns > MOST_CELLS:
                    raise RecordingError(self.path, "claims an absurd size", "write it again")
                return list(file.schema_arrow.names)
        except (ArrowException, OSError, ValueError) as err:
            raise RecordingError(self.path, _why(err), "write it again") from None

    def _read(self, names: list[str]) -> pyarrow.Table:
        try:
            if self._parquet:
                from pyarrow import parquet  # noqa: PLC0415

                return parquet.read_table(self.path, columns=names, memory_map=False)
            return self._read_csv(names)
        except MemoryError:
            raise RecordingError(self.path, "claims an absurd size", "write it again") from None
        except Exception as err:  # whatever a hostile table makes of the library
            raise RecordingError(self.path, _why(err), "write it again") from None

    def _read_csv(self, names: list[str]) -> pyarrow.Table:
        import pyarrow  # noqa: PLC0415
        from pyarrow import csv  # noqa: PLC0415

        def skip(_: object) -> str:
            self._skipped += 1
            return "skip"

        self._skipped = 0
        return csv.read_csv(
            self.path,
            read_options=csv.ReadOptions(
                use_threads=False,
                block_size=4 * LONGEST_LINE,
                skip_rows=self._before + 1,
                column_names=self.columns,
                encoding="latin-1",
            ),
            parse_options=csv.ParseOptions(
                delimiter=self._separator, invalid_row_handler=skip, newlines_in_values=False
            ),
            # As text first: a stray word must not cost a column, nor a float a time's last digits.
            convert_options=csv.ConvertOptions(
                include_columns=names,
                column_types=dict.fromkeys(names, pyarrow.string()),
                strings_can_be_null=False,
            ),
        )


#: Stands for a row without a time.
_NEVER = np.iinfo(np.int64).min


def _why(err: Exception) -> str:
    return f"is no readable table ({' '.join(str(err).split())[:120]})"


def _numbers(column: pyarrow.ChunkedArray) -> Array:
    """Return a column as floats, NaN where a cell holds no number."""
    from pyarrow import ArrowInvalid, ArrowNotImplementedError, compute, float64  # noqa: PLC0415

    try:
        if _is_text(column):
            column = compute.replace_substring_regex(column, pattern=r"^\s*$", replacement="nan")
        return np.asarray(_array(compute.cast(column, float64())), dtype=np.float64)
    except (ArrowInvalid, ArrowNotImplementedError):
        return np.array([_number(cell) for cell in column.to_pylist()], dtype=np.float64)


def _array(column: pyarrow.ChunkedArray) -> NDArray[Any]:
    """Return a column's numbers, in a way that leaves pandas asleep (half a second) if it can."""
    whole = column.combine_chunks()
    if whole.null_count:
        return np.asarray(whole.to_numpy(zero_copy_only=False))
    return np.from_dlpack(whole)


def _number(cell: object) -> float:
    try:
        return float(cell)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return float("nan")


def _is_text(column: pyarrow.ChunkedArray) -> bool:
    from pyarrow import types  # noqa: PLC0415

    return bool(types.is_string(column.type))


def _nanoseconds(column: pyarrow.ChunkedArray, clock: Clock) -> Nanoseconds:
    """Return a time column in whole ns, with every digit that a text holds."""
    from pyarrow import ArrowInvalid, compute, int64, types  # noqa: PLC0415

    unit = NANOSECONDS[clock.unit]
    if types.is_integer(column.type):
        return np.asarray(_array(column), dtype=np.int64) * unit
    if types.is_timestamp(column.type):
        whole = compute.cast(compute.cast(column, "timestamp[ns]"), int64())
        return np.asarray(_array(compute.fill_null(whole, _NEVER)), dtype=np.int64)
    seconds = _numbers(column)
    known = np.isfinite(seconds) & (np.abs(seconds) < 9e18 / unit)
    result = np.full(len(seconds), _NEVER, dtype=np.int64)
    result[known] = np.rint(seconds[known] * unit)
    if _is_text(column) and known.any() and np.abs(seconds[known]).max() > 1e6:
        # A float has some 16 digits, too few for nanoseconds since 1970.
        try:
            parts = compute.split_pattern(column.combine_chunks(), ".", max_splits=1)
            whole = compute.list_element(parts, 0)
            start = np.from_dlpack(compute.cast(whole, int64()))
        except ArrowInvalid:
            return result
        rest = np.zeros(len(seconds))
        for i, text in enumerate(column.to_pylist()):
            rest[i] = _number(f"0.{text.partition('.')[2]}") if "." in text else 0.0
        exact = known & np.isfinite(rest) & (start >= 0)
        result[exact] = start[exact] * unit + np.rint(rest[exact] * unit).astype(np.int64)
    return result
