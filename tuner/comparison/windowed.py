"""Simulated minus recorded, window by window from recorded starts, where no whole loop is flown.

A simulation that is fed motor commands, rotor speeds or rate set-points drifts away within seconds,
whatever its coefficients; over a window its error says how good they are. What no recording holds
exactly, a window's start and the trim of its rotors, is the likeliest for the vehicle that flies.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from sim_jax.crash import AIRBORNE
from tuner.coefficients.space import Space
from tuner.comparison.errors import FlightErrors, joined, laps_of, simulated_minus_recorded
from tuner.config import ControllerFile, VehicleFile
from tuner.flights.flight import Array, Flight
from tuner.model import model_of, schedule_of
from tuner.objective.criterion import Criterion, Point
from tuner.objective.inlets import InletName
from tuner.objective.normal import Objective
from tuner.objective.residuals import Trace
from tuner.objective.segments import CLOCKS, noise_of, window_segments
from tuner.objective.windows import windows_of
from tuner.search.continuation import FAR


class WindowComparison:
    """Recordings cut into windows once, to be flown with any number of vehicles.

    Parameters
    ----------
    flights
        Each with what the inlet needs.
    controller
        What flew.
    inlet
        What is fed in.
    seconds
        s, length of a window.
    time_offsets
        Flight name -> s by which its pose stamps are late.
    """

    def __init__(
        self,
        flights: Sequence[Flight],
        controller: ControllerFile,
        *,
        inlet: InletName,
        seconds: float,
        time_offsets: Mapping[str, float] | None = None,
    ) -> None:
        self._flights, self._controller = tuple(flights), controller
        self._offsets = dict(time_offsets or {})
        self._schedule = schedule_of(controller)
        self._windows = [windows_of(flight, seconds) for flight in flights]
        self._segments = window_segments(
            flights,
            inlets=[inlet] * len(flights),
            seconds=seconds,
            schedule=self._schedule,
            lag=LAG,
            noise=noise_of(flights),
        )
        self._samples = math.ceil((seconds + BEYOND) * self._schedule.log_rate)

    def fly(self, vehicle: VehicleFile) -> dict[str, FlightErrors]:
        """Return flight name to its errors with a vehicle, all windows behind each other."""
        objective = Objective(
            model=model_of(vehicle, self._controller),
            segments=self._segments,
            space=_NOTHING,
            schedule=self._schedule,
            samples=self._samples,
            limits=AIRBORNE,
        )
        point = objective.start(np.zeros(0))
        flown = self._flown(objective, point, self._starts(objective, point))
        position, attitude = (np.asarray(flown.channels[name]) for name in ("position", "attitude"))
        found, segment = {}, 0
        for flight, windows in zip(self._flights, self._windows, strict=True):
            parts = []
            for window in windows:
                errors = simulated_minus_recorded(
                    window.flight,
                    (position[..., segment], attitude[..., segment]),
                    rate=self._schedule.log_rate,
                    late=self._offsets.get(flight.name, 0.0),
                    crash_time=math.inf,
                )
                inside = errors.between(0.0, window.flight.duration)
                parts.append(inside.later(window.begin))
                segment += 1
            found[flight.name] = joined(flight.name, parts, laps_of(flight))
        return found

    def _starts(self, objective: Objective, point: Point) -> Array:
        """Return the likeliest starts (L, F), in the segments' standard deviations."""
        assert self._segments.freedom is not None
        states = np.zeros(self._segments.freedom.shape)
        flights = len(self._flights)
        for _ in range(ROUNDS):
            criterion = Criterion(
                horizon=jnp.asarray(self._samples),
                scale={name: jnp.full(flights, LOOSE) for name in self._segments.measured},
                held=jnp.zeros((len(CLOCKS), flights)),
                huber=jnp.asarray(jnp.inf),
                prior=jnp.asarray(1.0),
                states=jnp.asarray(states),
            )
            asked = np.asarray(objective.sums(point, criterion, derivatives=False).states)
            states = np.clip(np.where(np.isfinite(asked), asked, 0.0), -FAR, FAR)
        return states

    def _flown(self, objective: Objective, point: Point, states: Array) -> Trace:
        horizon = jnp.asarray(self._samples)
        trace: Trace = eqx.filter_jit(objective.flier.fly)(
            objective.tunable, self._segments, point.coefficients, horizon, jnp.asarray(states)
        )
        return trace


_NOTHING = Space([], {})
LAG = 0.03
"""s over which recent commands tell the speed of a rotor without tachometer."""
BEYOND = 0.02
"""s simulated beyond a window, for stamps that are late."""
LOOSE = 10.0
"""Multiple of the noise by which a simulation may miss before its start is doubted."""
ROUNDS = 3
"""Steps towards the likeliest start."""
