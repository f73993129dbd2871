"""What a finished search noticed that a user should know before believing a number."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from tuner.findings.findings import Code, Finding, Level
from tuner.objective.criterion import OFFSET_UNIT
from tuner.objective.segments import CLOCKS, OFFSETS
from tuner.search.problem import Job
from tuner.search.progress import COLOURED, Fitted, Loop, loop_of
from tuner.vehicle import VehicleFile

UNMATCHED = 10.0
"""Multiple of the noise beyond which a channel counts as not matched."""
EXPLAINED = 0.9
"""Share of the turning below which moments of inertia are said to be effective ones."""
LATE = 1e-3
"""s of an input's lateness from which it is said."""
ODD = 3.0
"""A flight this many times further off than the middle one is the odd one out."""

Scales = Mapping[str, Mapping[str, float]]


def unmatched(scales: Scales) -> dict[str, dict[str, float]]:
    """Return the flights most of whose channels are not matched, and those channels.

    Parameters
    ----------
    scales
        Flight -> channel -> residual in multiples of the noise.
    """
    lost = {}
    for flight, channels in scales.items():
        bad = {name: value for name, value in channels.items() if value > UNMATCHED}
        if len(bad) > len(channels) / 2:
            lost[flight] = bad
    return lost


def odd_flights(scales: Scales) -> frozenset[str]:
    """Return the flights that are not matched while all others are, to the noise.

    Another vehicle flew them, or something disturbed them alone: what is missing there is missing
    in none of the others. Scales are those of `unmatched`.
    """
    lost = unmatched(scales)
    others = [max(channels.values()) for name, channels in scales.items() if name not in lost]
    return frozenset(lost if len(lost) < len(others) and max(others) < COLOURED else ())


def findings_at(job: Job, fitted: Fitted) -> tuple[Finding, ...]:
    """Return what a fit shows about the set-up, the flights, their clocks and their gyros."""
    findings = [*end_findings(job, loop_of(fitted.objective), fitted.scales)]
    offsets = np.asarray(fitted.point.offsets)[: len(OFFSETS)] * OFFSET_UNIT
    for number, flight in enumerate(job.fitted):
        for kind, value in zip(OFFSETS, offsets[:, number].tolist(), strict=True):
            if value == 0.0:
                continue
            code, unit = (
                (Code.CLOCK_OFFSET, "seconds") if kind in CLOCKS else (Code.GYRO_OFFSET, "rate")
            )
            findings.append(Finding(code, "info", flight.name, {unit: value}, (kind,)))
    return tuple(findings)


def end_findings(job: Job, loop: Loop, scales: Scales) -> tuple[Finding, ...]:
    """Return what the end of a search shows about the set-up and the flights.

    Parameters
    ----------
    job
        What was searched.
    loop
        How the loop flies with which the search ended.
    scales
        As of `unmatched`.
    """
    findings = list(loop_findings(job, loop, "warning"))
    lost = unmatched(scales)
    typical = float(np.median([_size(channels) for channels in scales.values()]))
    alone = {name for name in lost if _size(scales[name]) > ODD * typical}
    findings += [
        Finding(Code.FLIGHT_UNMATCHED, "warning", name, lost[name]) for name in sorted(alone)
    ]
    shared = len(set(lost) - alone)
    if shared:
        numbers = {"unmatched": shared, "flights": len(scales), "noise_multiple": typical}
        findings.append(Finding(Code.MODEL_UNMATCHED, "warning", "model", numbers))
    return tuple(findings)


def loop_findings(job: Job, loop: Loop, level: Level) -> Iterator[Finding]:
    """Return in what the recordings contradict the controller file."""
    controller = job.settings.controller
    if loop.saturation_feedback != float(controller.mixer.saturation_feedback):
        numbers = {"feedback": loop.saturation_feedback}
        yield Finding(Code.SATURATION_FEEDBACK, level, "saturation_feedback", numbers)
    if loop.sees_markers != float(controller.sensing.sees_markers):
        yield Finding(Code.SEES_MARKERS, level, "sees_markers", {"seen": loop.sees_markers})


def inputs_late(job: Job) -> tuple[Finding, ...]:
    """Return which fitted flights' inputs are stamped late against their states."""
    return tuple(
        Finding(Code.INPUT_LATE, "info", r.flight.name, {"seconds": r.input_late})
        for r in job.recordings
        if not r.holdout and abs(r.input_late) > LATE
    )


def turning_unexplained(job: Job, explained: Mapping[str, float]) -> tuple[Finding, ...]:
    """Warn where recorded inputs explain too little of how fitted flights turn.

    Where no moment of inertia is fitted, as where attitudes are followed, there is nothing to warn
    of.

    Noise of the inputs, and the loop's own answer to what disturbs the vehicle, shrink the torque
    that a fit finds behind an input, by up to the share that it explains (errors in variables).

    Parameters
    ----------
    job
        Which flights are fitted, and what is free.
    explained
        Flight -> share of the squared change of body rate that is predicted.
    """
    of_fitted = [explained[flight.name] for flight in job.fitted if flight.name in explained]
    turns = any(name.startswith("inertia_") for name in job.space.names)
    share = float(np.median(of_fitted)) if of_fitted and turns else 1.0
    if share >= EXPLAINED:
        return ()
    numbers = {"explained": share}
    return (Finding(Code.TURNING_UNEXPLAINED, "warning", "moments of inertia", numbers),)


def voltage_taken(given: VehicleFile, best: VehicleFile) -> tuple[Finding, ...]:
    """Tell at which voltage the motors' curve holds, where the vehicle file left that open."""
    volts = best.battery.reference_voltage
    if given.battery.reference_voltage or not volts or not best.effects.get("battery_exponent"):
        return ()
    curve = "input_scaling, zero_position_armed"
    return (Finding(Code.REFERENCE_VOLTAGE, "info", curve, {"volts": volts}),)


def _size(channels: Mapping[str, float]) -> float:
    return float(np.median(list(channels.values())))
