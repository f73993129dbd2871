"""Which flights are compared whole, and which window by window."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from tuner.comparison.errors import Comparison, FlightErrors
from tuner.comparison.windowed import WindowComparison
from tuner.config import ControllerFile, JobFile, VehicleFile
from tuner.flights.flight import Flight
from tuner.objective.inlets import InletName, inlet_for


class Layout:
    """Recordings laid out by where they enter the loop, to be flown with any number of vehicles.

    Parameters
    ----------
    flights
        At least one.
    controller
        What flew.
    job
        Gives the inlets and the length of the windows.
    time_offsets
        Flight name -> s by which its pose stamps are late.

    Raises
    ------
    RecordingError
        A flight does not hold what its inlet needs.
    """

    def __init__(
        self,
        flights: Sequence[Flight],
        controller: ControllerFile,
        job: JobFile,
        time_offsets: Mapping[str, float] | None = None,
    ) -> None:
        self._names = [flight.name for flight in flights]
        groups: dict[InletName, list[Flight]] = {}
        for flight in flights:
            groups.setdefault(inlet_for(flight, said_inlet(job, flight.name)), []).append(flight)
        self._groups = [
            Comparison(members, controller, time_offsets)
            if inlet == "reference"
            else WindowComparison(
                members,
                controller,
                inlet=inlet,
                seconds=job.search.window,
                time_offsets=time_offsets,
            )
            for inlet, members in groups.items()
        ]

    def fly(self, vehicle: VehicleFile) -> dict[str, FlightErrors]:
        """Return flight name to its errors with a vehicle, in the flights' order."""
        found: dict[str, FlightErrors] = {}
        for group in self._groups:
            found |= group.fly(vehicle)
        return {name: found[name] for name in self._names}


def said_inlet(job: JobFile, name: str) -> str:
    """Return the inlet that a job says for a flight, ``auto`` if none."""
    own = job.flights.get(name)
    return job.inlet if own is None or own.inlet is None else own.inlet
