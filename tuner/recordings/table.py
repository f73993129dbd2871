"""Tables: CSV and Parquet, one row a time, one column a number."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from tuner.core.errors import RecordingError
from tuner.recordings.csv_layout import LONGEST_LINE, layout_of
from tuner.recordings.damage import Cause, Damage
from tuner.recordings.notes import Note, NoteCode
from tuner.recordings.recording import ROWS, Contents, Request, Samples, TabularRecording
from tuner.recordings.times import NEVER, UNIT_NAMES, numbers_of, read_times

if TYPE_CHECKING:
    import pyarrow

#: Tables with more columns or cells are no flight.
MOST_COLUMNS = 10_000
MOST_CELLS = 500_000_000


class Table(TabularRecording):
    """A CSV or Parquet file with a line of column names.

    Attributes
    ----------
    units
        Column -> what a row of units says of it.

    Raises
    ------
    RecordingError
        It is no table.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._skipped = 0
        self.units: Mapping[str, str] = {}
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
        fields = {name: numbers_of(table.column(name)) for name in request.fields}
        time, unit = read_times(self.path, table.column(clock.field), clock, fields.values())
        notes = []
        if unit is not None and unit != "s":
            told = (clock.field, UNIT_NAMES[unit])
            notes.append(Note(NoteCode.UNIT_READ, topic=ROWS, count=len(time), names=told))
        damage = [Damage(Cause.ROWS_MALFORMED, lost=self._skipped)] if self._skipped else []
        kept = time != NEVER
        if not kept.all():
            lost = int((~kept).sum())
            notes.append(Note(NoteCode.ROWS_WITHOUT_TIME, topic=ROWS, count=lost))
        fields = {name: values[kept] for name, values in fields.items()}
        samples = Samples(time[kept], time[kept], fields)
        return Contents({ROWS: samples}, tuple(notes), tuple(damage))

    def _csv_columns(self) -> list[str]:
        self._layout = layout_of(self.path)
        self.units = self._layout.units
        return list(self._layout.columns)

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
        from pyarrow import compute, csv  # noqa: PLC0415

        def skip(_: object) -> str:
            self._skipped += 1
            return "skip"

        self._skipped = 0
        layout = self._layout
        table = csv.read_csv(
            self.path if layout.separator != " " else _single_blanks(self.path),
            read_options=csv.ReadOptions(
                use_threads=False,
                block_size=4 * LONGEST_LINE,
                skip_rows=layout.lines_before,
                column_names=self.columns,
                encoding=layout.encoding,
            ),
            parse_options=csv.ParseOptions(
                delimiter=layout.separator, invalid_row_handler=skip, newlines_in_values=False
            ),
            # As text first: a stray word must not cost a column, nor a float a time's last digits.
            convert_options=csv.ConvertOptions(
                include_columns=names,
                column_types=dict.fromkeys(names, pyarrow.string()),
                strings_can_be_null=False,
            ),
        )
        if not layout.decimal_comma:
            return table
        cells = [compute.replace_substring(table.column(name), ",", ".") for name in names]
        return pyarrow.table(cells, names=names)


def _single_blanks(path: Path) -> io.BytesIO:
    """Return a text in which cells are apart by one blank."""
    with path.open("rb") as stream:
        return io.BytesIO(b"\n".join(b" ".join(line.split()) for line in stream))


def _why(err: Exception) -> str:
    return f"is no readable table ({' '.join(str(err).split())[:120]})"
