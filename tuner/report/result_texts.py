"""Sentences on a run's result: its ending, terms, effective coefficients, refits, exports."""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt
from pathlib import Path

from tuner.core.errors import InputError
from tuner.core.phrases import listed, percent
from tuner.evaluate.records import RMSE_UNITS
from tuner.result import EffectiveResult, Ending, FlightResult, RunResult
from tuner.uncertainty.records import Calibration
from tuner.vehicle.selection_table import SelectionRow

MIN_NEARLY_KEPT_GAIN = 0.01
"""A rejected term with a larger gain, as a share of the loss, is mentioned."""
MIN_REFIT_ERROR_RATIO = 2.0
"""An error of refits above so many standard errors of the fit is called larger."""


def refits_in_words(result: RunResult) -> tuple[str, ...]:
    """Return sentences on the errors by refits, if there are any.

    The relative error of a standard deviation of n normal values is 1 / sqrt(2 (n - 1)).
    """
    fitted = result.coefficients
    flights = sum(flight.split == "fit" for flight in result.flights)
    if flights < 2 or all(c.jackknife_error is c.bootstrap_error is None for c in fitted.values()):
        return ()
    known_to = 100 / sqrt(2 * (flights - 1))
    precision = (
        f"With {flights} flights, an error that comes of their differences is itself known to "
        f"about ±{known_to:.0f} %."
    )
    beyond = [
        name
        for name, found in fitted.items()
        if found.std_error is not None
        and max(found.jackknife_error or 0.0, found.bootstrap_error or 0.0)
        > MIN_REFIT_ERROR_RATIO * found.std_error
    ]
    if not beyond:
        agree = "The flights disagree about no coefficient by more than twice what the fit quotes."
        return precision, agree
    disagree = (
        f"The flights disagree about {listed(beyond)} by more than twice what the fit quotes: "
        "believe the larger error."
    )
    return precision, disagree


def ending_sentence(ending: Ending) -> str:
    """Return why a search stopped."""
    if ending is Ending.NO_FURTHER_GAIN:
        return "The search converged: its last steps gained nothing."
    return "The search stopped at its limit of iterations, before it converged."


def calibration_in_words(calibration: Calibration) -> str:
    """Return a sentence on the coverage of the 95 % intervals, for each kind of flight."""
    shares = [f"{100 * kind.coverage['95']:.0f} % ({kind.flights})" for kind in calibration.kinds]
    sets = sorted({kind.sets for kind in calibration.kinds})
    many = f"{sets[0]}" if len(sets) == 1 else f"{sets[0]} to {sets[-1]}"
    return (
        f"Measured in simulation, {many} sets of flights of each kind, with the terms that flew in "
        f"the model ({calibration.date}): {listed(shares)} of the 95 % intervals held the truth."
    )


def export_sentence(kind: str, outcome: Path | InputError) -> str:
    """Return where a format was written, or why it was refused."""
    if isinstance(outcome, Path):
        return f"The {kind} export was written to {outcome}."
    return f"The {kind} export was refused: {outcome}."


def effective_in_words(effective: EffectiveResult) -> str:
    """Return sentences on the effective coefficients and their RMSE."""
    lost = listed([term.group for term in effective.lost])
    text = (
        f"Gazebo cannot fly {lost}. With its effective coefficients it misses the flights by "
        f"{effective.rmse_effective.words}, the physical model by "
        f"{effective.rmse_physical.words}; with the physical coefficients and without "
        f"these terms it would be {effective.rmse_unfitted.words}."
    )
    if effective.carried:
        text += f" Gazebo has a place for {listed(effective.carried)}."
    return text


def simulator_lacks(effective: EffectiveResult) -> str:
    """Return a sentence on the terms that Gazebo lacks, and its RMSE."""
    return (
        f"Gazebo lacks {listed([term.group for term in effective.lost])}, and with effective "
        f"coefficients misses them by {effective.rmse_effective.words}."
    )


def nearly_kept(row: SelectionRow) -> bool:
    """Return whether a group that was left out gained a percent or more in the fit."""
    return not row.kept and (row.gain_fit or 0.0) >= MIN_NEARLY_KEPT_GAIN


def gain_in_words(gain: float | None) -> str:
    """Return a gain as a share of the loss in percent; a dash where it was not computed."""
    if gain is None:
        return "–"
    return percent(gain) if abs(gain) >= 1e-4 else "0 %"


def selection_in_words(rows: Sequence[SelectionRow]) -> str:
    """Return a sentence on which groups of terms were added; empty where none was asked."""
    if not rows:
        return ""
    kept = [row.group for row in rows if row.kept]
    if not kept:
        return "The flights do not call for any term beyond Gazebo's motor model."
    return f"Added to Gazebo's motor model: {listed(kept)}."


def starts_in_words(flights: Sequence[FlightResult]) -> tuple[str, ...]:
    """Return sentences on where the simulations of some flights begin, and what is fitted there."""
    sentences = []
    whole = [flight for flight in flights if flight.horizon is None]
    if whole:
        sentences.append(
            f"{_named(whole)}: flown whole in the closed loop from the recorded state at the "
            f"mission's start{_clocks(whole)}."
        )
    for horizon in sorted({flight.horizon for flight in flights if flight.horizon is not None}):
        cut = [flight for flight in flights if flight.horizon == horizon]
        sentences.append(
            f"{_named(cut)}: predicted open loop over {horizon:g} s at a time, from the recorded "
            f"state each; no start, trim or offset is fitted to a flight."
        )
        met = [flight for flight in cut if flight.rmse_fitted_starts is not None]
        if met:
            values = "; ".join(f"{flight.name} {_axes(flight)}" for flight in met)
            sentences.append(
                f"With fitted starts, one start and trim to each {horizon:g} s, the RMSE would be: "
                f"{values}."
            )
    return tuple(sentences)


def _named(flights: Sequence[FlightResult]) -> str:
    return listed([flight.name for flight in flights])


def _clocks(flights: Sequence[FlightResult]) -> str:
    parts = [
        f"the clock offset of {_named(some)} {words}"
        for clock, words in (("fitted", "was fitted"), ("assumed", "is taken to be zero"))
        if (some := [flight for flight in flights if flight.clock == clock])
    ]
    return f" ({'; '.join(parts)})" if parts else ""


def _axes(flight: FlightResult) -> str:
    assert flight.rmse_fitted_starts is not None
    values = {axis: getattr(flight.rmse_fitted_starts, axis) for axis in RMSE_UNITS}
    known = {axis: value for axis, value in values.items() if value is not None}
    named = [f"{axis} {value:.3g} {RMSE_UNITS[axis]}" for axis, value in known.items()]
    return ", ".join(named) or "crashes"  # a flight whose attitude is followed lacks some, not all
