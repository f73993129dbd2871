"""What a result folder's files hold of uncertainty and sensitivity, as data."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from tuner.core.disk import write_text
from tuner.core.files import FiniteOrNone, Part, ResultFile, csv_text


class ErrorParts(Part):
    """Standard errors of one coefficient, in its unit; the quoted one holds all of them.

    Each is that of a normal distribution with the 95 % interval that is meant, which is wider where
    few stretches of time or few flights speak.

    Attributes
    ----------
    noise
        Were measurement noise alone in the residuals.
    residuals
        With all that is in them: disturbances and what the model lacks.
    left_out
        As the estimate moves when flights are left out in turn (parts of them where they are few);
        None where there are no three.
    terms
        As it would move with terms that were tried and not kept, and where errors of measured
        rotor speeds pass for inertia; None where neither was tried.
    step
        Its move when the physics step is halved, and for a rotor's lag that it may be off by half
        of the finest step in which simulators take it; None where that was not asked.
    readings
        How it scatters when the battery's voltmeter is read again, with errors like those that it
        made; None where the fit has no battery, or estimates disturbances.
    lack
        How far it would move with the laws that recorded accelerations follow beside the model's;
        None where none was found.
    search
        How far one more linear step would move it: a search ends where its steps gain nothing.
    """

    noise: FiniteOrNone
    residuals: FiniteOrNone
    left_out: FiniteOrNone = None
    terms: FiniteOrNone = None
    step: FiniteOrNone = None
    readings: FiniteOrNone = None
    lack: FiniteOrNone = None
    search: FiniteOrNone = None


CONFLICT = 3.0
"""Standard errors apart beyond which ground measurements and flights contradict each other."""


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
THRESHOLD = 3.841459
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
        Where the rise passes `THRESHOLD`; None where it does not within the values.
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
MEANING = {
    "morris": ("mean effect μ", "mean absolute effect μ*", "standard deviation of the effect σ"),
    "sobol": ("first-order index", "total index", "95 % confidence of the total index"),
}


class SensitivityIndex(Part):
    """Effect of one coefficient on the logarithm of one RMSE; see `MEANING`.

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
        header = ("coefficient", "flight", "channel", *MEANING[self.method])
        rows = [
            [i.coefficient, i.flight or "all", i.channel or "all", i.main, i.total, i.spread]
            for i in self.indices
        ]
        write_text(folder / GLOBAL_TABLE, csv_text(header, rows))
