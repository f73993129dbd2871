"""What `tune` decides of one recording before it simulates anything, by its own functions."""

from __future__ import annotations

from pathlib import Path

from tuner.config import Settings
from tuner.core.errors import InputError
from tuner.findings.findings import Code, sentence
from tuner.job.recording_verdict import Verdict
from tuner.objective.inlets import bypassed_by
from tuner.search.job_flights import as_logged, read_usable, without_pose
from tuner.vehicle import COEFFICIENTS


def decide(path: Path, settings: Settings) -> Verdict:
    """Return whether and how `tune` would fit a recording, and why.

    Parameters
    ----------
    path
        The recording, the only one of the settings.
    """
    settings, logged = as_logged(settings)
    gains = tuple(g for f in logged if f.code is Code.LOGGED_GAINS for g in f.names)
    try:
        bare, _ = without_pose(settings)
        if bare:
            seconds = sum(end - begin for flight in bare for begin, end in flight.flying)
            seen = (
                f"No pose was recorded: body rate and specific force of {seconds:.0f} s in the air "
                "are fitted, from the motor commands."
            )
            return Verdict(str(path), True, ("none",), (seen,))
        recordings, findings = read_usable(settings, holdout=(), fits=False)
    except InputError as error:
        return Verdict(str(path), False, why=(f"{error.what}; {error.remedy}",))
    inlets = [recording.inlet for recording in recordings]
    bypassed = bypassed_by(inlets, [recording.flight for recording in recordings])
    why = tuple(dict.fromkeys(map(sentence, findings)))
    hidden = tuple(n for n in COEFFICIENTS if n in bypassed and not COEFFICIENTS[n].is_effect)
    return Verdict(str(path), True, tuple(inlets), why, hidden, gains)
