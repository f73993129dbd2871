"""What refits to other flights say about the standard errors of a fit."""

from __future__ import annotations

from math import sqrt

from tuner.result import RunResult
from tuner.wording.phrases import listed

APART = 2.0
"""Times the standard error of a fit beyond which that of refits is called larger."""


def refits_in_words(result: RunResult) -> tuple[str, ...]:
    """Return sentences on the errors by refits, none where there are none.

    An estimate of a standard deviation from n values is known to one part in the square root of
    2 (n - 1), if they are normal.
    """
    fitted = result.coefficients
    if all(c.jackknife_error is c.bootstrap_error is None for c in fitted.values()):
        return ()
    flights = sum(flight.split == "fit" for flight in result.flights)
    known_to = 100 / sqrt(2 * (flights - 1))
    precision = (
        f"With {flights} flights, an error that comes of their differences is itself known to "
        f"about ±{known_to:.0f} %."
    )
    beyond = [
        name
        for name, found in fitted.items()
        if found.std_error is not None
        and max(found.jackknife_error or 0.0, found.bootstrap_error or 0.0)
        > APART * found.std_error
    ]
    if not beyond:
        agree = "The flights disagree about no coefficient by more than twice what the fit quotes."
        return precision, agree
    disagree = (
        f"The flights disagree about {listed(beyond)} by more than twice what the fit quotes: "
        "believe the larger error."
    )
    return precision, disagree
