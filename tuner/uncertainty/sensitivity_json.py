"""Uncertainty and sensitivity of every coefficient on disk: ``sensitivity.json`` and its tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from tuner.core.disk import write_text
from tuner.core.files import FiniteOrNone, Part, ResultFile, csv_text
from tuner.uncertainty.directions import Direction
from tuner.uncertainty.records import Residual
from tuner.uncertainty.verdict import Reason, Verdict


class CoefficientKnowledge(Part):
    """Uncertainty of one coefficient, and where the information about it comes from.

    Attributes
    ----------
    unit
        Of the value and all that is derived from it.
    fitted
        Whether it was fitted; for a fixed one, all is given as if it had been fitted, too.
    value, std_error, ci95
        See `tuner.uncertainty.estimates.Estimate`.
    verdict, reason
        How well it is known, and why.
    step
        Change that counts as one hundred percent, see `tuner.uncertainty.local_sensitivity`.
    shares
        Channel -> flight -> share in the information about it.
    prior_share
        The priors' share, which is the rest.
    bias
        Of a fixed one: fitted coefficient -> percent by which that is wrong for each percent by
        which this one is.
    """

    unit: str
    fitted: bool
    value: float
    std_error: FiniteOrNone
    ci95: tuple[FiniteOrNone, FiniteOrNone]
    verdict: Verdict
    reason: Reason
    step: float
    shares: dict[str, dict[str, float]]
    prior_share: float
    bias: dict[str, float]

    def label(self, name: str) -> str:
        """Return its name as tables and figures have it: a fixed coefficient is called so."""
        return name if self.fitted else f"{name} (fixed)"


class OutputSensitivity(Part):
    """Effects of the coefficients on one recorded signal: an axis of a channel of a flight.

    Attributes
    ----------
    flight, channel, axis, unit
        Which signal.
    rmse
        Simulated minus recorded, in ``unit`` as everything here; None where the simulation crashed.
    change
        Coefficient -> RMS change for +1 %.
    rmse_up, rmse_down
        Coefficient -> RMSE for +10 % and −10 %; None where the simulation crashed.
    """

    flight: str
    channel: str
    axis: str
    unit: str
    rmse: FiniteOrNone
    change: dict[str, float]
    rmse_up: dict[str, FiniteOrNone]
    rmse_down: dict[str, FiniteOrNone]


class EffectOverTime(Part):
    """Effects of the coefficients over the time of one flight.

    Attributes
    ----------
    flight
        Its name.
    windowed
        Whether time counts from the start of each window of the flight, not from the mission's.
    time
        s, middles of equal stretches.
    change
        Coefficient -> RMS change of all channels for +1 % in each stretch, in standard deviations.
    span
        Coefficient -> s from and to which half of its squared effect falls; the shortest such
        stretch.
    """

    flight: str
    windowed: bool = False
    time: list[float]
    change: dict[str, list[float]]
    span: dict[str, tuple[float, float]]


class Knowledge(ResultFile):
    """The content of ``sensitivity.json``.

    Attributes
    ----------
    coefficients
        Name -> what is known of it; the fitted ones first.
    flights, channels
        Names.
    outputs, effects_over_time, residuals
        Of every recorded signal, of every flight, of every channel of a flight.
    directions
        The worst-determined combinations of the fitted coefficients, worst first.
    names
        The rows of the matrices: the fitted parameters; of a tie, the first of the group.
    correlation
        Of their estimates.
    covariance, information
        Covariance of their estimates, flights and priors together, and Fisher information of the
        flights alone; in the coefficients' units.
    """

    FILE = "sensitivity.json"
    INDENT = None

    schema_version: int = 2
    coefficients: dict[str, CoefficientKnowledge]
    flights: list[str]
    channels: list[str]
    outputs: list[OutputSensitivity]
    effects_over_time: list[EffectOverTime]
    residuals: list[Residual]
    directions: list[Direction]
    names: list[str]
    correlation: list[list[float]]
    covariance: list[list[float]]
    information: list[list[float]]


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
