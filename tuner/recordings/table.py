"""Tables: CSV and Parquet, with one row per time; their times in nanoseconds.

The unit of a table's times follows from their step: for sample rates from `MIN_SAMPLE_RATE_HZ` to
`MAX_SAMPLE_RATE_HZ` any step has exactly one of the units s, ms, µs and ns.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Mapping
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
from numpy.typing import NDArray
from pyarrow import (
    ArrowException,
    ArrowInvalid,
    ArrowNotImplementedError,
    compute,
    float64,
    int64,
    types,
)
from pyarrow import csv as arrow_csv

from tuner.core.errors import RecordingError, short_reason
from tuner.core.numerics import Array
from tuner.recordings.formats import MAX_LINE_BYTES, layout_of
from tuner.recordings.notes import Cause, Damage, Note, NoteCode
from tuner.recordings.recording import (
    NS_PER_SECOND,
    NS_PER_UNIT,
    TABLE_TOPIC,
    Clock,
    Nanoseconds,
    ReadResult,
    TabularRecording,
    TopicSamples,
)

#: Tables with more columns, or more cells to be read, are no flight.
MAX_COLUMNS = 10_000
MAX_CELLS = 500_000_000
#: Nor are files with more cells per byte, unless they have few cells: true numbers differ.
MAX_CELLS_PER_BYTE, MIN_CELL_LIMIT = 20, 20_000_000
_VEHICLE_COLUMN = re.compile(
    r"(^|[ _./])(id|name|drone|uav|vehicle|agent|robot|body|object|quad|cf)s?([ _]?(id|name))?$",
    re.I,
)
MAX_VEHICLES = 100
#: A column in which more cells hold digits and are no numbers is not read as it was written.
MAX_UNREAD_SHARE = 0.1
#: Rows are of several vehicles in turn if the next row is so often another's.
MIN_TURNS_SHARE = 0.3


class TableRecording(TabularRecording):
    """A CSV or Parquet file with a line of column names.

    Attributes
    ----------
    units
        Column -> unit, from a row of units.

    Raises
    ------
    RecordingError
        It is no table.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._skipped = 0
        self._rows = 0
        self.units: Mapping[str, str] = {}
        with path.open("rb") as stream:
            self._parquet = stream.read(4) == b"PAR1"
        if self._parquet:
            columns = self._parquet_columns()
        else:
            self._layout = layout_of(path)
            self.units, columns = self._layout.units, list(self._layout.columns)
        if len(set(columns)) < 2 or len(columns) > MAX_COLUMNS:
            raise RecordingError(
                path, f"{len(columns)} columns are no table of a flight", "check its first line"
            )
        super().__init__(path, "table", columns)

    def read(
        self, wanted: Mapping[str, tuple[str, ...]], clocks: tuple[Clock, ...] = ()
    ) -> ReadResult:
        """Read the wanted columns."""
        if TABLE_TOPIC not in wanted:
            return ReadResult({})
        clock = self.clock(clocks)
        names = list(dict.fromkeys([clock.field, *wanted[TABLE_TOPIC]]))
        table = self._read(names)
        self._require_one_vehicle(names)
        fields = {name: numbers_of(table.column(name)) for name in wanted[TABLE_TOPIC]}
        for name, numbers in fields.items():
            self._require_numbers(name, table.column(name), numbers)
        time, noted = read_times(self.path, table.column(clock.field), clock, fields.values())
        notes = list(noted)
        damage = [Damage(Cause.ROWS_MALFORMED, lost=self._skipped)] if self._skipped else []
        kept = time != NO_TIME
        if not kept.all():
            lost = int((~kept).sum())
            notes.append(NoteCode.ROWS_WITHOUT_TIME.note(topic=TABLE_TOPIC, count=lost))
        fields = {name: values[kept] for name, values in fields.items()}
        samples = TopicSamples(time[kept], time[kept], fields)
        return ReadResult({TABLE_TOPIC: samples}, tuple(notes), tuple(damage))

    def _require_numbers(self, name: str, cells: pyarrow.ChunkedArray, numbers: Array) -> None:
        """Refuse a column of text whose numbers are often written with other signs."""
        unread = np.isnan(numbers)
        if not is_text(cells) or not unread.any():
            return
        with_digits = compute.match_substring_regex(cells, r"^[^#]*\d[^#]*$")  # 1.#QNAN is none
        unread &= with_digits.to_numpy(zero_copy_only=False)
        if unread.mean() > MAX_UNREAD_SHARE:
            first = cells.take([int(np.argmax(unread))]).to_pylist()
            raise RecordingError(
                self.path,
                f"its '{name}' holds {first[0][:40]!r}, which is no number",
                "write numbers with a point for decimals, and their unit in the column's name",
            )

    def _require_one_vehicle(self, read: list[str]) -> None:
        """Refuse rows of several vehicles in turn."""
        for name in self.columns:
            if name in read or not _VEHICLE_COLUMN.search(name):
                continue
            cells = self._read([name]).column(name)
            if not (is_text(cells) or types.is_integer(cells.type)):
                continue
            vehicles = cells.unique().to_pylist()
            if not 2 <= len(vehicles) <= MAX_VEHICLES:
                continue
            rows = cells.combine_chunks().dictionary_encode().indices.to_numpy(zero_copy_only=False)
            if np.mean(rows[1:] != rows[:-1]) > MIN_TURNS_SHARE:
                shown = ", ".join(str(vehicle)[:20] for vehicle in vehicles[:3])
                raise RecordingError(
                    self.path,
                    f"its rows are of {len(vehicles)} vehicles in turn, by its '{name}': {shown}",
                    "write a table for each vehicle",
                )

    def _parquet_columns(self) -> list[str]:
        from pyarrow import parquet  # noqa: PLC0415 (a third of a second)

        try:
            with parquet.ParquetFile(self.path) as file:
                self._rows = file.metadata.num_rows
                return list(file.schema_arrow.names)
        except (ArrowException, OSError, ValueError) as err:
            raise RecordingError(self.path, _unreadable_reason(err), "write it again") from None

    def _read(self, names: list[str]) -> pyarrow.Table:
        cells, size = self._rows * len(names), self.path.stat().st_size
        if cells > min(MAX_CELLS, max(MIN_CELL_LIMIT, MAX_CELLS_PER_BYTE * size)):
            raise RecordingError(self.path, "claims an absurd size", "write it again")
        try:
            if self._parquet:
                from pyarrow import parquet  # noqa: PLC0415

                return parquet.read_table(self.path, columns=names, memory_map=False)
            return self._read_csv(names)
        except RecordingError:
            raise
        except MemoryError:
            raise RecordingError(self.path, "claims an absurd size", "write it again") from None
        except Exception as err:  # whatever a hostile table makes of the library
            raise RecordingError(self.path, _unreadable_reason(err), "write it again") from None

    def _read_csv(self, names: list[str]) -> pyarrow.Table:

        def skip(_: object) -> str:
            self._skipped += 1
            return "skip"

        self._skipped = 0
        layout = self._layout
        table = arrow_csv.read_csv(
            self.path if layout.separator != " " else _single_blanks(self.path),
            read_options=arrow_csv.ReadOptions(
                use_threads=False,
                block_size=4 * MAX_LINE_BYTES,
                skip_rows=layout.lines_before,
                column_names=self.columns,
                encoding=layout.encoding,
            ),
            parse_options=arrow_csv.ParseOptions(
                delimiter=layout.separator, invalid_row_handler=skip, newlines_in_values=False
            ),
            # As text first: a stray word must not cost a column, nor a float the digits of a time.
            convert_options=arrow_csv.ConvertOptions(
                include_columns=names,
                column_types=dict.fromkeys(names, pyarrow.string()),
                strings_can_be_null=False,
            ),
        )
        if not table.num_rows:
            what = f"has no row of {len(self.columns)} cells beneath its line of column names"
            remedy = "write a name for each cell of a row, and rows"
            raise RecordingError(self.path, what, remedy)
        if not layout.decimal_comma:
            return table
        cells = [compute.replace_substring(table.column(name), ",", ".") for name in names]
        return pyarrow.table(cells, names=names)


def _single_blanks(path: Path) -> io.BytesIO:
    """Return a text with single blanks between cells."""
    with path.open("rb") as stream:
        return io.BytesIO(b"\n".join(b" ".join(line.split()) for line in stream))


def _unreadable_reason(err: Exception) -> str:
    return f"is no readable table ({short_reason(err)})"


#: Stands for a row without a time.
NO_TIME = np.iinfo(np.int64).min
#: A factor of 1000 apart, as the units of time are.
MIN_SAMPLE_RATE_HZ, MAX_SAMPLE_RATE_HZ = 3.0, 3000.0
#: Stamps with more rows each have too few digits.
MAX_ROWS_PER_STAMP = 10
#: The step is the median over the samples of at most so many fields.
MAX_FIELDS = 24
UNIT_NAMES = {"ms": "in milliseconds", "us": "in microseconds", "ns": "in nanoseconds"}

_DATE = r"^\d{4}-\d{2}-\d{2}[T ]\d{2}:\d{2}:\d{2}(\.\d{1,9})?(Z|[+-]\d{2}(:?\d{2})?)?$"
_TIME_OF_DAY = r"^\d{2}:\d{2}:\d{2}(\.\d{1,9})?$"
_DAY = 24 * 3600 * NS_PER_SECOND


def read_times(
    path: Path, column: pyarrow.ChunkedArray, clock: Clock, fields: Iterable[Array]
) -> tuple[Nanoseconds, tuple[Note, ...]]:
    """Return the times (n,) of a table's rows in ns, `NO_TIME` of a row without.

    Parameters
    ----------
    column
        Whole numbers, floats, time stamps or text.
    clock
        Its clock in the topic map; without a unit, that follows from the step.
    fields
        (n,) of the signals, NaN where a row holds no sample.

    Returns
    -------
    tuple
        The times, and a note on a unit that was inferred and is not s.

    Raises
    ------
    RecordingError
        It holds neither numbers nor dates, its unit is uncertain, its stamps are too coarse, or its
        times start again.
    """
    if types.is_timestamp(column.type):
        whole = compute.cast(compute.cast(column, "timestamp[ns]"), int64())
        return np.asarray(array_of(compute.fill_null(whole, NO_TIME)), dtype=np.int64), ()
    numbers = numbers_of(column)
    sampled = [np.isfinite(field) for field in list(fields)[:MAX_FIELDS]] or [np.isfinite(numbers)]
    if is_text(column) and not np.isfinite(numbers).any():
        times, unit = _dates(path, column, clock.field), None
    else:
        unit = None if clock.unit else _unit_by_step(path, clock.field, numbers, sampled)
        times = _whole_nanoseconds(column, numbers, NS_PER_UNIT[clock.unit or unit or "s"])
    _require_fine_stamps(path, column, times, sampled)
    _require_one_start(path, clock.field, times)
    if unit is None or unit == "s":
        return times, ()
    read = NoteCode.UNIT_READ.note(
        clock.field, UNIT_NAMES[unit], topic=TABLE_TOPIC, count=len(times)
    )
    return times, (read,)


def numbers_of(column: pyarrow.ChunkedArray) -> Array:
    """Return a column as floats, NaN where a cell holds no number."""
    try:
        if is_text(column):
            column = compute.utf8_trim_whitespace(column)
            column = compute.replace_substring_regex(column, pattern=r"^$", replacement="nan")
        return np.asarray(array_of(compute.cast(column, float64())), dtype=np.float64)
    except (ArrowInvalid, ArrowNotImplementedError):
        return np.array([_number(cell) for cell in column.to_pylist()], dtype=np.float64)


def array_of(column: pyarrow.ChunkedArray) -> NDArray[Any]:
    """Return a column's numbers, if possible without the import of pandas (half a second)."""
    whole = column.combine_chunks()
    if whole.null_count:
        return np.asarray(whole.to_numpy(zero_copy_only=False))
    return np.from_dlpack(whole)


def is_text(column: pyarrow.ChunkedArray) -> bool:
    """Return whether a column holds text."""
    return bool(types.is_string(column.type))


def _number(cell: object) -> float:
    try:
        return float(cell)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return float("nan")


def _unit_by_step(
    path: Path, field: str, numbers: Array, sampled: list[NDArray[np.bool_]]
) -> str | None:
    """Return the unit of times whose step is that of a flight."""
    steps = []
    for there in sampled:
        between = np.diff(np.sort(numbers[there & np.isfinite(numbers)]))
        steps.append(float(np.median(between[between > 0])) if (between > 0).any() else np.nan)
    if not np.isfinite(steps).any():
        return None
    step = float(np.nanmedian(steps))
    for unit, factor in NS_PER_UNIT.items():
        if MIN_SAMPLE_RATE_HZ <= NS_PER_SECOND / (step * factor) < MAX_SAMPLE_RATE_HZ:
            return unit
    raise RecordingError(
        path,
        f"its '{field}' goes on by {step:g} from one sample to the next, which is no step of a "
        "flight in s, ms, us or ns",
        f"give its unit in a topic map (time: {{field: {field}, unit: ms}})",
    )


def _whole_nanoseconds(column: pyarrow.ChunkedArray, numbers: Array, unit: int) -> Nanoseconds:
    """Return a column of numbers in whole ns, with all digits of a text."""
    known = np.isfinite(numbers) & (np.abs(numbers) < 9e18 / unit)
    result = np.full(len(numbers), NO_TIME, dtype=np.int64)
    if types.is_integer(column.type) and not column.null_count:
        result[known] = np.asarray(array_of(column), dtype=np.int64)[known] * unit
        return result
    result[known] = np.rint(numbers[known] * unit)
    if is_text(column) and known.any() and np.abs(numbers[known]).max() > 1e6:
        # A float has some 16 digits, too few for nanoseconds since 1970.
        cells = column.to_pylist()
        for row in np.flatnonzero(known):
            result[row] = round(Decimal(cells[row].strip()) * unit)
    return result


def _dates(path: Path, column: pyarrow.ChunkedArray, field: str) -> Nanoseconds:
    """Return dates and times of day in ns, since 1970 or since midnight."""
    text = compute.utf8_trim_whitespace(column.combine_chunks())
    text = compute.replace_substring(text, ",", ".")
    text = compute.replace_substring(text, "/", "-")
    of_day = compute.match_substring_regex(text, _TIME_OF_DAY)
    only_of_day = bool(compute.any(of_day).as_py())
    text = compute.if_else(of_day, compute.binary_join_element_wise("1970-01-01", text, " "), text)
    dated = compute.match_substring_regex(text, _DATE)
    cells = compute.if_else(dated, text, None)
    for zone in (None, "UTC") if compute.any(dated).as_py() else ():
        try:
            stamps = compute.cast(cells, pyarrow.timestamp("ns", zone))
        except ArrowInvalid:  # some have a zone and some have none
            continue
        whole = compute.fill_null(compute.cast(stamps, pyarrow.int64()), NO_TIME)
        times = np.asarray(np.from_dlpack(whole), dtype=np.int64)
        return _with_days_counted(times) if only_of_day else times
    first = next((cell for cell in column.to_pylist() if cell), "")
    raise RecordingError(
        path,
        f"its '{field}' holds {first[:40]!r}, which is neither a number nor a date",
        "write seconds, or dates as 2026-04-02T14:13:00.123",
    )


def _with_days_counted(times: Nanoseconds) -> Nanoseconds:
    known = times != NO_TIME
    on = times[known]
    days = np.concatenate([[0], np.cumsum(np.diff(on) < -_DAY // 2)])
    result = times.copy()
    result[known] = on + days * _DAY
    return result


def _require_fine_stamps(
    path: Path, column: pyarrow.ChunkedArray, times: Nanoseconds, sampled: list[NDArray[np.bool_]]
) -> None:
    """Refuse stamps with so few digits that many rows share them."""
    there = times[max(sampled, key=np.count_nonzero)]
    there = there[there != NO_TIME]
    different = len(np.unique(there))
    if len(there) >= 2 * MAX_ROWS_PER_STAMP and different * MAX_ROWS_PER_STAMP <= len(there):
        first = str(column[0].as_py()).strip()[:30]
        raise RecordingError(
            path,
            f"its {len(there)} rows have {different} different times: '{first}' has too few digits",
            "write the time with its fraction of a second, or count from the recording's start",
        )


RESTART_ROWS = 50
RESTART_NS = NS_PER_SECOND
"""Times that go back by more, for so many rows, start again."""


def _require_one_start(path: Path, field: str, times: Nanoseconds) -> None:
    """Refuse times that start again: rows of two flights would be sorted into one.

    A clock that is set back to before the first row mixes nothing.
    """
    known = times[times != NO_TIME]
    for row in np.flatnonzero(np.diff(known) < -RESTART_NS)[:100] + 1:
        before, after = known[max(row - RESTART_ROWS, 0) : row], known[row : row + RESTART_ROWS]
        if len(before) == len(after) == RESTART_ROWS and (
            known[:row].min() < np.median(after) < np.median(before) - RESTART_NS
        ):
            raise RecordingError(
                path,
                f"its '{field}' goes back by {(known[row - 1] - known[row]) / 1e9:.3g} s at row "
                f"{row + 1} and starts again there",
                "write a table for each flight or vehicle",
            )
