"""Whether and how recordings can be fitted: the decisions of `tune` before any simulation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from tuner.config import Settings, resolve_settings
from tuner.core.errors import InputError
from tuner.core.phrases import listed
from tuner.findings.findings import Code, sentence
from tuner.options import Options
from tuner.recordings.cache import cache_file, digest, load_or_compute, source_version
from tuner.recordings.inspection import Inspection
from tuner.recordings.topics import read_sidecar
from tuner.recordings.ulog import LoggingAdvice, logger_settings, logging_advice, parameters_of
from tuner.vehicle import COEFFICIENTS


@dataclass(frozen=True)
class RecordingVerdict:
    """The decision of `tune` on a recording.

    Attributes
    ----------
    fits
        Whether something can be fitted to it.
    inlets
        Inlet of each of its missions; ``none`` for a log without a pose.
    why
        Reasons in sentences: why it cannot be fitted, or why it has these inlets.
    not_shown
        Coefficients upstream of the inlets, without effect on this recording.
    gains
        Differences of the log's own parameters from the controller file.
    logging
        Messages to log more often.
    settings
        The logger's settings that do that; empty where nothing is missing.
    """

    path: str
    fits: bool
    inlets: tuple[str, ...] = ()
    why: tuple[str, ...] = ()
    not_shown: tuple[str, ...] = ()
    gains: tuple[str, ...] = ()
    logging: tuple[LoggingAdvice, ...] = ()
    settings: str = ""


def verdict_of(
    inspection: Inspection,
    *,
    topics: str | None = None,
    namespace: str | None = None,
    vehicle: str | None = None,
) -> RecordingVerdict:
    """Return the decision of `tune` on a recording, by the job file beside it.

    Raises
    ------
    InputError
        The settings are wrong, rather than the recording.
    """
    path = Path(inspection.path)
    options = Options([str(path)], topics=topics, namespace=namespace, vehicle=vehicle)
    decided = _cached_verdict(path, resolve_settings(options, fits=False))
    parameters = parameters_of(path)
    logging: tuple[LoggingAdvice, ...] = ()
    if inspection.format == "ulog" and inspection.duration > 0:
        rates = {
            topic.name: topic.rate or topic.count / inspection.duration
            for topic in inspection.topics
        }
        logging = logging_advice(rates)
    words = logger_settings(logging, parameters)
    return replace(decided, logging=logging, settings=words)


def _cached_verdict(path: Path, settings: Settings) -> RecordingVerdict:
    """Return the decision, from the cache if it is known."""
    job = settings.job
    inputs = settings.vehicle, settings.controller, job, read_sidecar(path)
    maps = [digest(file) for file in (job.topics,) if file is not None and file.exists()]
    key = (digest(path), path.name, source_version(), *map(repr, (*inputs, *maps)))

    verdict = load_or_compute(
        RecordingVerdict, cache_file("verdict", *key), lambda: _computed_verdict(path, settings)
    )
    return replace(verdict, path=str(path))


def _computed_verdict(path: Path, settings: Settings) -> RecordingVerdict:
    """Return whether and how the only recording of some settings would be fitted, and why."""
    from tuner.core.runtime import configure  # noqa: PLC0415 (jax takes a second)

    configure()
    from tuner.objective.inlets import bypassed_by  # noqa: PLC0415
    from tuner.search.job_flights import (  # noqa: PLC0415
        read_inertial_flights,
        read_recordings,
        with_logged_parameters,
    )

    settings, logged = with_logged_parameters(settings)
    gains = tuple(g for f in logged if f.code is Code.LOGGED_GAINS for g in f.names)
    try:
        bare, _ = read_inertial_flights(settings)
        if bare:
            seconds = sum(end - begin for flight in bare for begin, end in flight.flying)
            seen = (
                f"No pose was recorded: body rate and specific force of {seconds:.0f} s in the air "
                "are fitted, from the motor commands."
            )
            return RecordingVerdict(str(path), True, ("none",), (seen,))
        recordings, findings = read_recordings(settings, holdout=(), fits=False)
    except InputError as error:
        return RecordingVerdict(str(path), False, why=(f"{error.what}; {error.remedy}",))
    inlets = [recording.inlet for recording in recordings]
    bypassed = bypassed_by(inlets, [recording.flight for recording in recordings])
    why = tuple(dict.fromkeys(map(sentence, findings)))
    hidden = tuple(n for n in COEFFICIENTS if n in bypassed and not COEFFICIENTS[n].is_effect)
    return RecordingVerdict(str(path), True, tuple(inlets), why, hidden, gains)


def with_verdict(inspection: Inspection, verdict: RecordingVerdict) -> Inspection:
    """Return an inspection that counts on no coefficient above the chosen inlets."""
    coefficients = (
        replace(of, how="no", why=f"acts above the inlet {' and '.join(verdict.inlets)}")
        if of.coefficient in verdict.not_shown
        else of
        for of in inspection.coefficients
    )
    return replace(inspection, coefficients=tuple(coefficients))


def in_words(verdict: RecordingVerdict) -> list[str]:
    """Return a verdict as lines: the decision, its reasons, and advice on logging."""
    if not verdict.fits:
        return [f"cannot be fitted: {verdict.why[0]}", *_logger_in_words(verdict)]
    if verdict.inlets == ("none",):
        lines = ["can be fitted without motion capture"]
    else:
        inlets = dict.fromkeys(verdict.inlets)
        lines = [f"can be fitted, through the inlet {listed(tuple(inlets))}"]
    lines += [f"  {why}" for why in verdict.why]
    if verdict.not_shown:
        act = "acts" if len(verdict.not_shown) == 1 else "act"
        lines.append(f"  It cannot show {listed(verdict.not_shown)}, which {act} above there.")
    if verdict.gains:
        lines.append(f"  The log's own parameters are simulated: {'; '.join(verdict.gains)}.")
    return [*lines, *_logger_in_words(verdict)]


def _logger_in_words(verdict: RecordingVerdict) -> list[str]:
    """Return the advice on logging, a line for each message."""
    lines = []
    for advice in verdict.logging:
        logged = f"{advice.logged:.0f} Hz" if advice.logged else "not logged"
        lines.append(
            f"  {advice.message}: {logged}, {advice.wanted:.0f} Hz would show {advice.shows}"
        )
    if verdict.settings:
        lines.append(f"  That is logged by {verdict.settings}.")
    return lines
