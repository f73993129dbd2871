"""What a finished search noticed that a user should know before believing a number."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from tuner.config import COEFFICIENTS
from tuner.job.prepare import Job
from tuner.objective.segments import CLOCKS, OFFSETS
from tuner.search.fitted import Finding
from tuner.uncertainty.estimates import Uncertainty

UNMATCHED = 10.0
"""Multiple of the noise beyond which a channel counts as not matched."""
STEPS_MATTER = 1e-4
"""s of a lag: the shipped recordings, flown at 4 kHz, are met best by one 0.14 ms too short."""
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
    found = {}
    for flight, channels in scales.items():
        bad = {name: value for name, value in channels.items() if value > UNMATCHED}
        if len(bad) > len(channels) / 2:
            found[flight] = bad
    return found


def offsets_found(job: Job, offsets: NDArray[np.float64]) -> tuple[Finding, ...]:
    """Say which clocks and gyros were found to be off.

    Parameters
    ----------
    job
        Gives the flights' names.
    offsets
        (offsets, N) in s and rad/s.
    """
    found = []
    for number, flight in enumerate(job.fitted):
        for kind, value in zip(OFFSETS, offsets[:, number], strict=True):
            if value != 0.0:
                what = kind.replace("_", " ")
                text = (
                    f"the {what} clock is {1000 * value:+.2f} ms late"
                    if kind in CLOCKS
                    else f"the {what} axis reads {value:+.4f} rad/s too much"
                )
                found.append(Finding("info", flight.name, f"{text}; taken into account"))
    return tuple(found)


def noticed(job: Job, feedback: float, scales: Scales) -> tuple[Finding, ...]:
    """Return what the end of a search says about the set-up and the flights.

    Parameters
    ----------
    job
        What was searched.
    feedback
        The mixer's saturation feedback that was flown in the end.
    scales
        As of `unmatched`.
    """
    found: list[Finding] = []
    said = 1.0 if job.settings.controller.mixer.saturation_feedback else 0.0
    if feedback != said:
        found.append(
            Finding(
                "warning",
                "saturation_feedback",
                "rotors were clipped low, and the recording agrees with a rate integrator that "
                + ("does not stop then" if feedback == 0 else "stops then")
                + f"; fitted with mixer.saturation_feedback: {str(feedback == 1).lower()}",
                "say so in the controller file",
            )
        )
    lost = unmatched(scales)
    typical = np.median([_size(channels) for channels in scales.values()])
    odd = {name for name in lost if len(scales) == 1 or _size(scales[name]) > ODD * typical}
    found += [_odd_one(name, lost[name]) for name in sorted(odd)]
    if set(lost) - odd:
        found.append(
            Finding(
                "warning",
                "model",
                f"the residuals of {len(set(lost) - odd)} of {len(scales)} flights are some "
                f"{typical:.0f} times the noise: the model lacks something that they all have",
                "believe held-out flights rather than standard errors",
            )
        )
    return tuple(found)


def surer_than_steps(uncertainty: Uncertainty) -> tuple[Finding, ...]:
    """Warn of lags whose intervals tell the noise alone, and not that time goes in steps."""
    names = [
        name
        for name, estimate in uncertainty.estimates.items()
        if COEFFICIENTS[name].unit == "s" and 0.0 < estimate.std_error < STEPS_MATTER
    ]
    if not names:
        return ()
    text = (
        f"the intervals are narrower than {1000 * STEPS_MATTER:g} ms, which is how much simulators "
        "whose physics runs in other steps differ by"
    )
    remedy = f"take them as known to {2000 * STEPS_MATTER:g} ms"
    return (Finding("warning", ", ".join(names), text, remedy),)


def _size(channels: Mapping[str, float]) -> float:
    return float(np.median(list(channels.values())))


def _odd_one(name: str, channels: Mapping[str, float]) -> Finding:
    text = ", ".join(f"{channel} {value:.1f}" for channel, value in channels.items())
    return Finding(
        "warning",
        name,
        f"cannot be matched: residuals in multiples of the noise are {text}; "
        "it was weighed down accordingly",
        "look at its plots: wrong controller, clock, wind, damage, or another vehicle",
    )
