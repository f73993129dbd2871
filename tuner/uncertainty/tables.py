"""An examination as tables for other programs: long CSV files and matrices."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from tuner.core.disk import write_text
from tuner.core.files import csv_text
from tuner.uncertainty.sensitivity_json import Knowledge

SENSITIVITY_FILE = "sensitivity.csv"
SHARES_FILE = "information_shares.csv"
MATRICES = ("correlation", "covariance", "information")

COLUMNS = (
    "coefficient",
    "fitted",
    "flight",
    "channel",
    "axis",
    "unit",
    "rms_change_1pct",
    "rmse",
    "rmse_plus_10pct",
    "rmse_minus_10pct",
    "half_effect_from",
    "half_effect_to",
    "information_share",
)


def write_files(knowledge: Knowledge, folder: Path) -> tuple[Path, ...]:
    """Write everything into a folder, and return the paths.

    ``sensitivity.csv`` has one row for each coefficient and axis of a channel of a flight;
    ``information_share`` is the whole channel's on that flight; half of the coefficient's squared
    effect on the flight falls between ``half_effect_from`` and ``half_effect_to``, in s. The
    matrices are square, their first column and first row the names; covariance and information in
    the coefficients' units.

    Raises
    ------
    OutputError
        The folder cannot be written to.
    """
    knowledge.write(folder)
    texts = {
        SENSITIVITY_FILE: csv_text(COLUMNS, _sensitivity(knowledge)),
        SHARES_FILE: csv_text(("coefficient", "flight", "channel", "share"), _shares(knowledge)),
    }
    for name in MATRICES:
        rows = zip(knowledge.names, getattr(knowledge, name), strict=True)
        header = ("coefficient", *knowledge.names)
        texts[f"{name}.csv"] = csv_text(header, ([coefficient, *row] for coefficient, row in rows))
    for name, text in texts.items():
        write_text(folder / name, text)
    return tuple(folder / name for name in texts)


def _sensitivity(knowledge: Knowledge) -> Iterable[Sequence[object]]:
    spans = {flight.flight: flight.span for flight in knowledge.effects_over_time}
    for name, known in knowledge.coefficients.items():
        for output in knowledge.outputs:
            if name not in output.change:
                continue  # tied to another, whose rows hold for both
            yield [
                name,
                int(known.fitted),
                output.flight,
                output.channel,
                output.axis,
                output.unit,
                output.change[name],
                output.rmse,
                output.rmse_up[name],
                output.rmse_down[name],
                *spans[output.flight][name],
                known.shares[output.channel][output.flight],
            ]


def _shares(knowledge: Knowledge) -> Iterable[Sequence[object]]:
    for name, known in knowledge.coefficients.items():
        for channel, flights in known.shares.items():
            for flight, share in flights.items():
                yield [name, flight, channel, share]
        yield [name, "", "prior", known.prior_share]
