"""What terms that were found say of a vehicle, its autopilot and its files."""

from __future__ import annotations

from tuner.findings.findings import Code, Finding
from tuner.search.fitted import Fitted
from tuner.uncertainty.estimates import Uncertainty
from tuner.vehicle import COEFFICIENTS, term_groups

SHOWN = (
    "thrust_exponent",
    "motor_lag",
    "rate_gain",
    "autopilot_tilt",
    "gyro_scale",
    "tachometer_lag",
)
"""Groups of terms of which is said what they mean."""


def terms_shown(fitted: Fitted, uncertainty: Uncertainty) -> tuple[Finding, ...]:
    """Return what terms that were found say that a lab can act on."""
    findings = []
    for group in SHOWN:
        known = {
            name: estimate
            for name in term_groups()[group]
            if (estimate := uncertainty.estimates.get(name)) and name not in fitted.held
        }
        if any(_differs(name, *estimate.ci95) for name, estimate in known.items()):
            numbers = {name: estimate.value for name, estimate in known.items()}
            numbers |= {f"{name}_error": estimate.std_error for name, estimate in known.items()}
            findings.append(Finding(Code.TERM_SHOWS, "warning", group, numbers, tuple(known)))
    return tuple(findings)


def _differs(name: str, low: float, high: float) -> bool:
    """Return whether an interval of a term's coefficient does not hold its neutral value."""
    neutral = COEFFICIENTS[name].neutral
    return neutral is not None and not low <= neutral <= high
