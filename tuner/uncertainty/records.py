"""Records of uncertainty and sensitivity in a result folder's files."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Literal, Self

from pydantic import Field, model_validator

from tuner.core.disk import write_text
from tuner.core.files import FiniteOrNone, Part, ResultFile, csv_text
from tuner.core.yaml_section import refuse
from tuner.evaluate.records import AxesRmse
from tuner.uncertainty.verdict import Direction, Reason, Verdict


class Refit(Part):
    """A fit to other flights, and how well it predicts one of them that it leaves out.

    Attributes
    ----------
    left_out
        That flight; None where none is to be predicted.
    coefficients
        Name -> value.
    rmse
        Of that flight, simulated with them; None where their inertia is no rigid body's.
    """

    left_out: str | None = None
    coefficients: dict[str, float] = Field(default_factory=dict)
    rmse: AxesRmse | None = None


CONFLICT_SE = 3.0
"""Standard errors of difference beyond which ground and flights contradict each other."""


class Sources(Part):
    """A coefficient from ground measurements, from flights alone, and from both, in its unit.

    ``flights`` is None where they do not identify it. ``deviation`` is that of flights from the
    ground in standard errors, model error included.
    """

    ground: float
    ground_error: FiniteOrNone
    flights: FiniteOrNone
    flights_error: FiniteOrNone
    both: float
    both_error: FiniteOrNone
    deviation: FiniteOrNone


class Residual(Part):
    """The residuals of one channel of one flight: white noise, or not.

    Attributes
    ----------
    flight, channel
        Names.
    rms
        In standard deviations of the measurement noise.
    spacing
        s from lag to lag.
    autocorrelation
        (L,) mean over the axes, from lag 0, where it is 1.
    limit
        Half the band within which 95 % of the lags of white noise lie.
    memory
        Correlation time in s: the integral of the autocorrelation's square, on either side of 0; a
        sample's spacing for white noise.
    white
        Whether at most twice the share of lags expected by chance lies outside the band.
    """

    flight: str
    channel: str
    rms: float
    spacing: float
    autocorrelation: list[float]
    limit: float
    memory: float
    white: bool


PROFILES_TABLE = "profiles.csv"
CHI_SQUARE_95 = 3.841459
"""Rise of χ² (one degree of freedom) at the true value that 95 % of experiments stay below."""


class Profile(Part):
    """Profile of one coefficient.

    Attributes
    ----------
    name, unit
        Of the coefficient.
    values
        At which it was fixed.
    rise
        χ² above its lowest, the others fitted again, over the square by which the standard error
        is widened for residuals that are no white noise; None where that failed.
    quadratic
        The rise that the standard error predicts.
    interval
        Where the rise passes `CHI_SQUARE_95`; None where it does not within the values.
    """

    name: str
    unit: str
    values: list[float]
    rise: list[FiniteOrNone]
    quadratic: list[float]
    interval: tuple[float | None, float | None]


class Profiles(ResultFile):
    """The content of ``profiles.json``."""

    FILE = "profiles.json"

    profiles: list[Profile]

    def write(self, folder: Path) -> None:
        """Write ``profiles.json`` and, for other programs, ``profiles.csv``."""
        super().write(folder)
        rows = [
            [profile.name, *row]
            for profile in self.profiles
            for row in zip(profile.values, profile.rise, profile.quadratic, strict=True)
        ]
        header = ("coefficient", "value", "chi_square_rise", "quadratic")
        write_text(folder / PROFILES_TABLE, csv_text(header, rows))


Method = Literal["morris", "sobol"]
GLOBAL_TABLE = "global_sensitivity.csv"

#: Method -> what the attributes `main`, `total` and `spread` of a `SensitivityIndex` are.
INDEX_MEANINGS = {
    "morris": ("mean effect μ", "mean absolute effect μ*", "standard deviation of the effect σ"),
    "sobol": ("first-order index", "total index", "95 % confidence of the total index"),
}


class SensitivityIndex(Part):
    """Effect of one coefficient on the logarithm of one RMSE; see `INDEX_MEANINGS`.

    ``flight`` and ``channel`` are empty for the mean over all of them.
    """

    coefficient: str
    flight: str
    channel: str
    main: float
    total: float
    spread: float


class GlobalSensitivity(ResultFile):
    """The content of ``global_sensitivity.json``.

    Attributes
    ----------
    method
        Of Morris or of Sobol.
    bounds
        Coefficient -> between which values it was varied.
    simulations, crashed
        How many vehicles were simulated, and how many of them crashed on some flight.
    indices
        Coefficient by coefficient, output by output.
    """

    FILE = "global_sensitivity.json"

    method: Method
    bounds: dict[str, tuple[float, float]]
    simulations: int
    crashed: int
    indices: list[SensitivityIndex]

    def write(self, folder: Path) -> None:
        """Write ``global_sensitivity.json`` and, for other programs, ``.csv``."""
        super().write(folder)
        header = ("coefficient", "flight", "channel", *INDEX_MEANINGS[self.method])
        rows = [
            [i.coefficient, i.flight or "all", i.channel or "all", i.main, i.total, i.spread]
            for i in self.indices
        ]
        write_text(folder / GLOBAL_TABLE, csv_text(header, rows))


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
        Change that counts as one hundred percent, see `tuner.uncertainty.sensitivity`.
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


class Knowledge(ResultFile):
    """The content of ``sensitivity.json``.

    Attributes
    ----------
    coefficients
        Name -> its record; the fitted ones first.
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

    def write(self, folder: Path) -> None:
        """Write ``sensitivity.json`` and, for other programs, tables.

        ``sensitivity.csv`` has one row for each coefficient and axis of a channel of a flight;
        ``information_share`` is the whole channel's on that flight; half of the coefficient's
        squared effect on the flight falls between ``half_effect_from`` and ``half_effect_to``, in
        s. The matrices are square, their first column and first row the names; covariance and
        information in the coefficients' units.
        """
        super().write(folder)
        share = ("coefficient", "flight", "channel", "share")
        texts = {
            SENSITIVITY_FILE: csv_text(COLUMNS, _sensitivity(self)),
            SHARES_FILE: csv_text(share, _shares(self)),
        }
        for name in MATRICES:
            rows = zip(self.names, getattr(self, name), strict=True)
            header = ("coefficient", *self.names)
            texts[f"{name}.csv"] = csv_text(header, ([own, *row] for own, row in rows))
        for name, text in texts.items():
            write_text(folder / name, text)

    @model_validator(mode="after")
    def _hold_all_of_each_coefficient(self) -> Self:
        outputs = self.outputs
        for name in {name for output in outputs for name in output.change}:
            record = self.coefficients.get(name)
            if record is None or not all(
                name in output.change
                and name in output.rmse_up
                and name in output.rmse_down
                and output.flight in record.shares.get(output.channel, ())
                for output in outputs
            ):
                raise refuse(f"lacks a part of what is known of {name}", "was it edited?")
        for effect in self.effects_over_time:
            if any(len(change) != len(effect.time) for change in effect.change.values()):
                raise refuse(f"lacks an effect over the time of {effect.flight}", "was it edited?")
        return self


def _sensitivity(knowledge: Knowledge) -> Iterable[Sequence[object]]:
    spans = {flight.flight: flight.span for flight in knowledge.effects_over_time}
    for name, record in knowledge.coefficients.items():
        for output in knowledge.outputs:
            if name not in output.change:
                continue  # tied to another, whose rows hold for both
            yield [
                name,
                int(record.fitted),
                output.flight,
                output.channel,
                output.axis,
                output.unit,
                output.change[name],
                output.rmse,
                output.rmse_up[name],
                output.rmse_down[name],
                *spans[output.flight][name],
                record.shares[output.channel][output.flight],
            ]


def _shares(knowledge: Knowledge) -> Iterable[Sequence[object]]:
    for name, record in knowledge.coefficients.items():
        for channel, flights in record.shares.items():
            for flight, share in flights.items():
                yield [name, flight, channel, share]
        yield [name, "", "prior", record.prior_share]


CALIBRATION = Path(__file__).with_name("calibration.json")
"""Measured coverage of the intervals; `benchmarks.calibration` writes it."""
COVERAGE_LEVELS = ("50", "80", "95")
"""Nominal coverage of intervals, per cent."""


class CoverageRecord(Part):
    """Coverage of the intervals of one kind of flight.

    Attributes
    ----------
    flights
        The disturbances beside measurement noise.
    sets, intervals
        Number of sets flown, and of intervals compared.
    coverage
        Level in per cent -> share of intervals that held the truth.
    least
        Coverage of the coefficient whose 95 % intervals held it least often.
    """

    flights: str
    sets: int
    intervals: int
    coverage: dict[str, float]
    least: float


class Calibration(Part):
    """Coverage for every kind of flight, and the date of its measurement."""

    date: str
    kinds: tuple[CoverageRecord, ...]


@lru_cache(maxsize=1)
def calibration() -> Calibration:
    """Return the measured coverage."""
    return Calibration.model_validate_json(CALIBRATION.read_text(encoding="utf-8"))
