"""What was measured of the intervals, as a sentence."""

from __future__ import annotations

from tuner.uncertainty.calibration import Calibration
from tuner.wording.phrases import listed


def calibration_in_words(calibration: Calibration) -> str:
    """Return how many of the 95 % intervals held the truth, for each kind of flight."""
    shares = [f"{100 * kind.coverage['95']:.0f} % ({kind.flights})" for kind in calibration.kinds]
    sets = sorted({kind.sets for kind in calibration.kinds})
    many = f"{sets[0]}" if len(sets) == 1 else f"{sets[0]} to {sets[-1]}"
    return (
        f"Measured in simulation, {many} sets of flights of each kind, with the terms that flew in "
        f"the model ({calibration.date}): {listed(shares)} of the 95 % intervals held the truth."
    )
