"""Simulated minus recorded, window by window from recorded starts, where no whole loop is flown.

A simulation that is fed motor commands, rotor speeds or rate set-points drifts away within seconds,
whatever its coefficients; over a window from the recorded state its error says how good they are.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import equinox as eqx
import numpy as np

from sim_jax.crash import AIRBORNE
from sim_jax.rollout import rollout
from tuner.comparison.errors import FlightErrors, joined, laps_of, simulated_minus_recorded
from tuner.config import ControllerFile, VehicleFile
from tuner.flights.flight import Flight
from tuner.model import model_of, schedule_of
from tuner.objective.freedom import spun_up
from tuner.objective.inlets import InletName
from tuner.objective.lanes import window_lanes
from tuner.objective.windows import windows_of


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
        self._lanes = window_lanes(
            flights, inlet=inlet, seconds=seconds, schedule=self._schedule, lag=LAG, noise={}
        )
        self._samples = math.ceil((seconds + BEYOND) * self._schedule.log_rate)

    def fly(self, vehicle: VehicleFile) -> dict[str, FlightErrors]:
        """Return flight name to its errors with a vehicle, all windows behind each other."""
        model, lanes = model_of(vehicle, self._controller), self._lanes
        assert lanes.turning is not None
        flown = eqx.filter_jit(rollout)(
            model.vehicle,
            model.controller,
            self._schedule,
            lanes.inlet,
            spun_up(lanes.start, model.vehicle, lanes.turning),
            samples=self._samples,
            limits=AIRBORNE,
        )
        motion = flown.log.motion
        position = np.moveaxis(np.asarray(motion.position.stacked(), dtype=np.float64), 0, 1)
        attitude = np.moveaxis(np.asarray(motion.attitude.stacked(), dtype=np.float64), 0, 1)
        found, lane = {}, 0
        for flight, windows in zip(self._flights, self._windows, strict=True):
            parts = []
            for window in windows:
                errors = simulated_minus_recorded(
                    window.flight,
                    (position[..., lane], attitude[..., lane]),
                    rate=self._schedule.log_rate,
                    late=self._offsets.get(flight.name, 0.0),
                    crash_time=math.inf,
                )
                parts.append(errors.later(window.begin))
                lane += 1
            found[flight.name] = joined(flight.name, parts, laps_of(flight))
        return found


LAG = 0.03
"""s over which recent commands tell the speed of a rotor without tachometer."""
BEYOND = 0.02
"""s simulated beyond a window, for stamps that are late."""
