"""The problem of a job: free coefficients, noise and objective of its recordings."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sim_jax.state import AIRBORNE, Limits
from tuner.config import CHANNELS, ErrorKind, FlightSettings, InletName, JobFile, Settings
from tuner.core.errors import ConfigError, RecordingError
from tuner.core.numerics import finite_rows
from tuner.equation_error.estimate import RegressionEstimate
from tuner.objective.battery import VOLTAGE, require_voltage, with_reference_voltage
from tuner.objective.initial_conditions import begins_gently
from tuner.objective.inlets import INLETS, also_free_by, bypassed_by, window_seconds
from tuner.objective.normal_equations import Objective
from tuner.objective.segments import (
    Segments,
    cut_windows,
    noise_of,
    segments_of,
    stamped_earlier,
    window_segments,
)
from tuner.objective.space import Space, space_of
from tuner.recordings.flight import Flight
from tuner.search.job_flights import JobFlight
from tuner.vehicle import condition_rows, initial_values
from tuner.vehicle.model import model_of, schedule_of

#: Channels of a yaw spin that is not held level: nothing holds its position, so that a gust or a
#: tilt of a hundredth of a degree moves it by metres.
SPIN_CHANNELS = ("body_rate", "rotor_speed", "command")

WINDOW_STRIDE = 0.5
"""Share of a window after which the next one begins, where windows start as recorded."""
CLIPPED_COMMAND = 0.005
"""A recorded command below this is a rotor clipped low."""
#: Closer to the simulator's floor than this, in m, a recording does not end at the floor.
FLOOR_CLEARANCE_M = 0.3


@dataclass(frozen=True)
class Job:
    """A problem with its settings and recordings.

    Attributes
    ----------
    settings
        Settings of the search.
    recordings
        The fitted ones, then those held out.
    noise
        Channel -> standard deviation in its unit (attitude: rad).
    space
        Free coefficients.
    objective
        The loss: of whole flights where all enter as reference, else of windows.
    windows
        The same flights in windows, searched first where one does not begin gently; None where
        all do.
    first_terms
        Groups of terms that are free from the beginning of the search.
    user_settings
        The user's settings: ``settings`` may start from a regression.
    accelerations
        Estimates by regression of the flights' accelerations, if physical coefficients are taken
        from it (`tuner.job.prepare`).
    """

    settings: Settings
    recordings: tuple[JobFlight, ...]
    noise: Mapping[str, float]
    space: Space
    objective: Objective
    user_settings: Settings
    windows: Objective | None = None
    first_terms: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    accelerations: RegressionEstimate | None = None

    @property
    def flights(self) -> tuple[Flight, ...]:
        """All flights, the fitted ones first."""
        return tuple(recording.flight for recording in self.recordings)

    @property
    def fitted(self) -> tuple[Flight, ...]:
        """The flights that are fitted."""
        return tuple(recording.flight for recording in self.recordings if not recording.holdout)

    @property
    def inlets(self) -> tuple[InletName, ...]:
        """Where each fitted flight enters the simulated loop."""
        return tuple(recording.inlet for recording in self.recordings if not recording.holdout)

    @property
    def initial(self) -> dict[str, float]:
        """Every coefficient's initial value."""
        return initial_values(self.settings.vehicle, self.settings.controller, self.space.free)

    def undecided(self, objective: Objective) -> dict[str, NDArray[np.bool_]]:
        """Return the choices of a `Loop` that matter to a problem -> informative flights (N,).

        Nothing saturates where no rotor was clipped, and markers at the centre of mass and along
        the body's axes make no difference.
        """
        marked = any(
            name.startswith("marker_")
            for name in (*objective.model.vehicle.effects, *objective.space.names)
        )
        matters = {
            "saturation_feedback": [
                flight.has("command") and bool((flight.signals["command"] < CLIPPED_COMMAND).any())
                for flight in self.fitted
            ],
            "sees_markers": [marked and INLETS[inlet].closed_loop for inlet in self.inlets],
        }
        return {
            choice: np.array(informative)
            for choice, informative in matters.items()
            if any(informative)
        }


def job_of(settings: Settings, recordings: Sequence[JobFlight]) -> Job:
    """Build the problem of some recordings.

    Raises
    ------
    RecordingError
        All of them are held out.
    ConfigError
        Nothing that was recorded is compared.
    """
    recordings = tuple(sorted(recordings, key=lambda recording: recording.holdout))
    to_fit = [recording for recording in recordings if not recording.holdout]
    if not to_fit:
        raise RecordingError(
            "--holdout", "all flights are held out, none is left to fit", "leave one to fit"
        )
    fitted = [recording.flight for recording in to_fit]
    has_voltage = all(flight.has(VOLTAGE) for flight in fitted)
    if has_voltage:
        settings = replace(settings, vehicle=with_reference_voltage(settings.vehicle, fitted))
    inlets = [recording.inlet for recording in to_fit]
    job = settings.job
    channels = [name for name in CHANNELS if job.channels.get(name, True)]
    noise = noise_of(fitted, channels)
    space = space_of(
        settings.vehicle,
        settings.controller,
        job,
        settings.bench,
        bypassed=bypassed_by(inlets, fitted),
        also_free=also_free_by(inlets, terms=job.terms == "auto"),
    )
    if "battery_exponent" in space.free or space.fixed.get("battery_exponent"):
        require_voltage(fitted)
    schedule = schedule_of(settings.controller)
    compared = [
        stamped_earlier(
            r.flight, [n for n in CHANNELS if n in r.flight.series], r.time_offset or 0.0
        )
        for r in to_fit
    ]
    closed = all(INLETS[inlet].closed_loop for inlet in inlets)
    longest = max(flight.duration for flight in fitted) + 1.0 / fitted[0].rate
    model = model_of(settings.vehicle, settings.controller)
    if not has_voltage:  # battery_exponent would act on some flights and not on others
        model = replace(model, reference_voltage=None)

    def problem(segments: Segments, seconds: float, limits: Limits) -> Objective:
        if not segments.measured:
            raise ConfigError(
                "channels", "none that is left on was recorded and is simulated", "leave one on"
            )
        samples = int(np.ceil(seconds * schedule.log_rate - 1e-6))
        return Objective(
            model,
            segments,
            space,
            schedule,
            samples,
            limits,
            conditions=_conditions(job, segments.measured),
        )

    seconds = window_seconds(inlets, job.search.window)
    windows, free_starts = None, _free_starts(job.search.criterion, inlets)
    stride = None if free_starts else WINDOW_STRIDE * seconds
    if not closed or not all(begins_gently(flight) for flight in fitted):
        pieces = cut_windows(
            compared,
            inlets=inlets,
            seconds=seconds,
            stride=stride,
            free_starts=free_starts,
            input_late={recording.flight.name: recording.input_late for recording in to_fit},
        )
        segments = window_segments(
            compared,
            pieces,
            inlets=inlets,
            schedule=schedule,
            lag=settings.vehicle.motor.time_constant_up,
            noise=noise,
            weights=_weights(settings, fitted, whole=False),
            free_starts=free_starts,
        )
        windows = problem(segments, min(longest, seconds + 1.0 / fitted[0].rate), AIRBORNE)
    if closed:
        whole = segments_of(
            compared, noise=noise, weights=_weights(settings, fitted, whole=True), schedule=schedule
        )
        objective = problem(whole, longest, limits_of(fitted))
        return Job(settings, recordings, noise, space, objective, settings, windows)
    assert windows is not None
    return Job(settings, recordings, noise, space, windows, settings)


def _free_starts(criterion: ErrorKind, inlets: Sequence[InletName]) -> bool:
    """Return whether windows have free initial states, rather than recorded ones.

    Raises
    ------
    ConfigError
        Predictions are asked for, and the recordings lack some of the initial states.
    """
    if criterion == "auto":
        return not all(INLETS[inlet].starts_recorded for inlet in inlets)
    for inlet in inlets:
        if criterion == "prediction" and "rate_integral" not in INLETS[inlet].ignores:
            raise ConfigError(
                "search.criterion",
                f"prediction begins at recorded states, and for the {inlet} inlet no recording "
                "holds that of the rate controller",
                "use inlet: actuator or rotor_speed, or criterion: output",
            )
    return criterion == "output"


def _conditions(job: JobFile, channels: Collection[str]) -> tuple[str, ...]:
    """Return the per-flight conditions to estimate: those of the job's terms.

    And the accelerometer's bias where acceleration is compared.
    """
    named = set() if isinstance(job.terms, str) else set(job.terms)
    if "acceleration" in channels:
        named.add("accelerometer")
    return tuple(name for name, row in condition_rows().items() if named & {name, row.group})


def _weights(
    settings: Settings, flights: Sequence[Flight], *, whole: bool
) -> dict[str, dict[str, float]]:
    """Return flight -> channel -> factor, zero for the position of a whole free yaw spin."""
    weights: dict[str, dict[str, float]] = {}
    for flight in flights:
        factor = settings.job.flights.get(flight.name, FlightSettings()).weight
        of_channel = {name: factor * settings.job.weights.get(name, 1.0) for name in CHANNELS}
        if whole and flight.spins_freely:
            of_channel |= {name: 0.0 for name in CHANNELS if name not in SPIN_CHANNELS}
        weights[flight.name] = of_channel
    return weights


def limits_of(flights: Sequence[Flight]) -> Limits:
    """Return the limits outside which a simulation counts as crashed.

    Those of the simulator, unless a recording itself comes near its floor or leaves them.
    """
    arena = Limits()
    for flight in flights:
        places = flight.series["position"].between(0.0, flight.duration).values
        places = places[finite_rows(places)]
        low = places[:, 2].min() < arena.floor + FLOOR_CLEARANCE_M
        if low or np.abs(places).max() > arena.half_width / 2:
            return AIRBORNE
    return arena
