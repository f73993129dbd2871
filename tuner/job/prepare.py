"""From settled options to the problem that is searched: flights read, noise told, segments laid."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sim_jax.crash import AIRBORNE, Limits
from tuner.coefficients.space import Space, space_of
from tuner.comparison.compare import flights_of
from tuner.comparison.errors import limits_of
from tuner.comparison.layout import said_inlet
from tuner.config import Settings
from tuner.errors import RecordingError
from tuner.flights.flight import Flight, Series
from tuner.model import model_of, schedule_of
from tuner.objective.inlets import InletName, inlet_for
from tuner.objective.noise import CHANNELS
from tuner.objective.normal import Objective
from tuner.objective.segments import Segments, begins_gently, noise_of, segments_of, window_segments

#: What a yaw spin is compared by: nothing holds its position, so that a gust or a tilt of a
#: hundredth of a degree moves it by metres without meaning anything.
SPIN_CHANNELS = ("body_rate", "rotor_speed", "command")

CLIPPED = 0.005
"""A recorded command below this is a rotor clipped low."""


@dataclass(frozen=True)
class Job:
    """A problem and what it was made of.

    Attributes
    ----------
    settings
        The user's.
    fitted, held_out
        Flights.
    noise
        Channel -> standard deviation in its unit (attitude: rad).
    space
        Free coefficients.
    inlets
        Where each fitted recording enters the simulated loop: whole flights where all enter as
        reference, else windows.
    objective
        What is searched.
    windows
        The same flights in windows, searched first where one does not begin gently; None where
        all do.
    """

    settings: Settings
    fitted: tuple[Flight, ...]
    held_out: tuple[Flight, ...]
    noise: Mapping[str, float]
    space: Space
    inlets: tuple[InletName, ...]
    objective: Objective
    windows: Objective | None = None

    @property
    def flights(self) -> tuple[Flight, ...]:
        """Every flight, the fitted ones first."""
        return (*self.fitted, *self.held_out)

    @property
    def clipped(self) -> bool:
        """Tell whether some recorded rotor was clipped low."""
        return any(
            bool((np.nan_to_num(flight.signals["command"], nan=1.0) < CLIPPED).any())
            for flight in self.fitted
            if flight.has("command")
        )


def prepare(settings: Settings) -> Job:
    """Read the flights and build the problem.

    Raises
    ------
    InputError
        A recording cannot be read or used, or the job leaves nothing to fit.
    """
    flights = flights_of(settings)
    held = set(settings.job.holdout)
    fitted = tuple(flight for flight in flights if flight.name not in held)
    held_out = tuple(flight for flight in flights if flight.name in held)
    if not fitted:
        raise RecordingError("--holdout", "holds out every flight", "leave one to fit")
    return job_of(settings, fitted, held_out)


def job_of(settings: Settings, fitted: tuple[Flight, ...], held_out: tuple[Flight, ...]) -> Job:
    """Build the problem of some flights."""
    job = settings.job
    channels = [name for name in CHANNELS if job.channels.get(name, True)]
    noise = noise_of(fitted, channels)
    space = space_of(settings.vehicle, settings.controller, job)
    schedule = schedule_of(settings.controller)
    on_time = [_shifted(flight, given_offset(settings, flight.name) or 0.0) for flight in fitted]
    inlets = _inlets(settings, fitted)
    closed = set(inlets) == {"reference"}
    longest = max(flight.duration for flight in fitted) + 1.0 / fitted[0].rate
    model = model_of(settings.vehicle, settings.controller)

    def problem(segments: Segments, seconds: float, limits: Limits) -> Objective:
        samples = int(np.ceil(seconds * schedule.log_rate - 1e-6))
        return Objective(model, segments, space, schedule, samples, limits)

    windows = None
    if not closed or not all(begins_gently(flight) for flight in fitted):
        segments = window_segments(
            on_time,
            inlets=inlets,
            seconds=job.search.window,
            schedule=schedule,
            lag=settings.vehicle.motor.time_constant_up,
            noise=noise,
            weights=_weights(settings, fitted, whole=False),
        )
        windows = problem(
            segments, min(longest, job.search.window + 1.0 / fitted[0].rate), AIRBORNE
        )
    if closed:
        whole = segments_of(on_time, noise=noise, weights=_weights(settings, fitted, whole=True))
        objective = problem(whole, longest, limits_of(fitted))
        return Job(settings, fitted, held_out, noise, space, inlets, objective, windows)
    assert windows is not None
    return Job(settings, fitted, held_out, noise, space, inlets, windows)


def _inlets(settings: Settings, flights: Sequence[Flight]) -> tuple[InletName, ...]:
    """Return where each recording enters the simulated loop."""
    return tuple(inlet_for(flight, said_inlet(settings.job, flight.name)) for flight in flights)


def given_offset(settings: Settings, name: str) -> float | None:
    """Return the s by which a flight's clocks are said to be late; None where that is fitted."""
    own = settings.job.flights.get(name)
    said = settings.job.time_offset if own is None or own.time_offset is None else own.time_offset
    return None if said == "free" else float(said)


def _shifted(flight: Flight, late: float) -> Flight:
    """Return a flight whose measurements are stamped as if its clocks had not been late."""
    if late == 0.0:
        return flight
    series = {
        name: Series(one.time - late, one.values) if name in CHANNELS else one
        for name, one in flight.series.items()
    }
    return replace(flight, series=series)


def _weights(
    settings: Settings, flights: Sequence[Flight], *, whole: bool
) -> dict[str, dict[str, float]]:
    """Return flight -> channel -> factor; a whole yaw spin's position means nothing."""
    weights: dict[str, dict[str, float]] = {}
    for flight in flights:
        own = settings.job.flights.get(flight.name)
        factor = 1.0 if own is None else own.weight
        of_flight = {name: factor * settings.job.weights.get(name, 1.0) for name in CHANNELS}
        if whole and flight.yaw_rate_setpoint is not None:
            of_flight |= {name: 0.0 for name in CHANNELS if name not in SPIN_CHANNELS}
        weights[flight.name] = of_flight
    return weights
