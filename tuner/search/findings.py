"""Findings of a fit at the end of a search."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace

import numpy as np

from tuner.findings.findings import Code, Finding, Level
from tuner.objective.criterion import OFFSET_UNIT
from tuner.objective.segments import CLOCKS, OFFSETS
from tuner.search.problem import Job
from tuner.search.progress import COLOURED_RATIO, Fit, Loop, loop_of
from tuner.vehicle import VehicleFile

UNMATCHED_RATIO = 10.0
"""Residuals over noise above which a channel is not matched."""
MIN_TURNING_EXPLAINED = 0.9
"""Explained share of the turning below which moments of inertia are reported as effective ones."""
MIN_REPORTED_LATENESS_S = 1e-3
OUTLIER_RATIO = 3.0
"""Residuals over those of the median flight above which a flight is an outlier."""

Scales = Mapping[str, Mapping[str, float]]


def unmatched(scales: Scales) -> dict[str, dict[str, float]]:
    """Return the flights most of whose channels are not matched, and those channels.

    Parameters
    ----------
    scales
        Flight -> channel -> residual in multiples of the noise.
    """
    bad = {
        flight: {name: value for name, value in channels.items() if value > UNMATCHED_RATIO}
        for flight, channels in scales.items()
    }
    return {flight: of for flight, of in bad.items() if len(of) > len(scales[flight]) / 2}


def outlying_flights(scales: Scales) -> frozenset[str]:
    """Return the flights that are not matched while all others are matched to the noise.

    Another vehicle flew them, or something disturbed them alone: the model's errors there are in
    none of the others. Scales are those of `unmatched`.
    """
    outliers = unmatched(scales)
    others = [max(channels.values()) for name, channels in scales.items() if name not in outliers]
    return frozenset(
        outliers if len(outliers) < len(others) and max(others) < COLOURED_RATIO else ()
    )


UNMATCHED_CODES = frozenset({Code.FLIGHT_UNMATCHED, Code.MODEL_UNMATCHED})
END_CODES = UNMATCHED_CODES | frozenset(
    {
        Code.SATURATION_FEEDBACK,
        Code.SEES_MARKERS,
        Code.CLOCK_OFFSET,
        Code.GYRO_OFFSET,
    }
)
"""Codes of findings that hold for one end of a search, and not for the next."""


def with_end_findings(job: Job, fitted: Fit) -> Fit:
    """Return a fit with the findings at its end instead of those of the fits before it."""
    findings = [finding for finding in fitted.findings if finding.code not in END_CODES]
    findings += loop_findings(job, loop_of(fitted.objective), "warning")
    findings += unmatched_findings(fitted.scales)
    offsets = np.asarray(fitted.point.offsets)[: len(OFFSETS)] * OFFSET_UNIT
    findings += [
        Code.CLOCK_OFFSET.info(flight.name, kind, seconds=value)
        if kind in CLOCKS
        else Code.GYRO_OFFSET.info(flight.name, kind, rate=value)
        for flight, of_flight in zip(job.fitted, offsets.T.tolist(), strict=True)
        for kind, value in zip(OFFSETS, of_flight, strict=True)
        if value != 0.0
    ]
    return replace(fitted, findings=tuple(findings))


def unmatched_findings(scales: Scales, matched: Collection[str] = ()) -> Iterator[Finding]:
    """Return the warnings of flights that are not matched, and of a model that misses several.

    Parameters
    ----------
    scales
        As of `unmatched`.
    matched
        Flights that estimated disturbances explain: a simulated yaw spin in gusts, whose position
        nothing holds, may be far from the recorded one.
    """
    flights = {name: bad for name, bad in unmatched(scales).items() if name not in matched}
    typical = float(np.median([_size(channels) for channels in scales.values()]))
    alone = {name for name in flights if _size(scales[name]) > OUTLIER_RATIO * typical}
    for name in sorted(alone):
        yield Code.FLIGHT_UNMATCHED.warning(name, **flights[name])
    shared = len(set(flights) - alone)
    if shared:
        yield Code.MODEL_UNMATCHED.warning(
            "model", unmatched=shared, flights=len(scales), noise_multiple=typical
        )


def loop_findings(job: Job, loop: Loop, level: Level) -> Iterator[Finding]:
    """Return the choices in which the recordings contradict the controller file."""
    controller = job.settings.controller
    if loop.saturation_feedback != float(controller.mixer.saturation_feedback):
        yield Code.SATURATION_FEEDBACK.at(
            level, "saturation_feedback", feedback=loop.saturation_feedback
        )
    if loop.sees_markers != float(controller.sensing.sees_markers):
        yield Code.SEES_MARKERS.at(level, "sees_markers", seen=loop.sees_markers)


def late_input_findings(job: Job) -> Iterator[Finding]:
    """Return findings on fitted flights whose inputs are stamped later than their states."""
    for recording in job.recordings:
        if not recording.holdout and abs(recording.input_late) > MIN_REPORTED_LATENESS_S:
            yield Code.INPUT_LATE.info(recording.flight.name, seconds=recording.input_late)


def turning_findings(job: Job, explained: Mapping[str, float]) -> Iterator[Finding]:
    """Warn where recorded inputs explain too little of how fitted flights turn.

    Noise of the inputs, and the loop's response to disturbances, shrink the torque that a fit finds
    per input, by up to the share that it explains (errors in variables). There is no warning where
    no moment of inertia is fitted.

    Parameters
    ----------
    job
        Gives the fitted flights and the free coefficients.
    explained
        Flight -> predicted share of the squared change of body rate.
    """
    of_fitted = [explained[flight.name] for flight in job.fitted if flight.name in explained]
    turns = any(name.startswith("inertia_") for name in job.space.names)
    if of_fitted and turns and (share := float(np.median(of_fitted))) < MIN_TURNING_EXPLAINED:
        yield Code.TURNING_UNEXPLAINED.warning("moments of inertia", explained=share)


def reference_voltage_findings(initial: VehicleFile, best: VehicleFile) -> Iterator[Finding]:
    """Return the finding on the reference voltage, where the vehicle file has none."""
    volts = best.battery.reference_voltage
    if volts and best.effects.get("battery_exponent") and not initial.battery.reference_voltage:
        yield Code.REFERENCE_VOLTAGE.info("input_scaling, zero_position_armed", volts=volts)


def _size(channels: Mapping[str, float]) -> float:
    return float(np.median(list(channels.values())))
