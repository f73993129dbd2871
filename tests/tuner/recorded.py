"""Recordings of flights that a test has, with a job's settings."""

from collections.abc import Iterable

from tuner.config import Settings
from tuner.recordings.flight import Flight
from tuner.search.job_flights import JobFlight, recording_of


def recordings_of(settings: Settings, flights: Iterable[Flight]) -> tuple[JobFlight, ...]:
    """Return flights with the inlet, clock offset and holdout of a job's settings."""
    held_out = settings.job.holdout
    return tuple(recording_of(settings, f, holdout=f.name in held_out) for f in flights)
