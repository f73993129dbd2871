"""What the standard error of a coefficient is made of, as data."""

from __future__ import annotations

from tuner.core.files import FiniteOrNone, Part


class ErrorParts(Part):
    """Standard errors of one coefficient, in its unit; the quoted one holds all of them.

    Each is that of a normal distribution with the 95 % interval that is meant, which is wider where
    few stretches of time or few flights speak.

    Attributes
    ----------
    noise
        Were measurement noise alone in the residuals.
    residuals
        With all that is in them: disturbances and what the model lacks.
    left_out
        As the estimate moves when flights are left out in turn (parts of them where they are few);
        None where there are no three.
    terms
        As it would move with terms that were tried and not kept, and where errors of measured
        rotor speeds pass for inertia; None where neither was tried.
    step
        Its move when the physics step is halved, and for a rotor's lag that it may be off by half
        of the finest step in which simulators take it; None where that was not asked.
    readings
        How it scatters when the battery's voltmeter is read again, with errors like those that it
        made; None where the fit has no battery, or follows what pushed the flights.
    search
        How far one more linear step would move it: a search ends where its steps gain nothing.
    """

    noise: FiniteOrNone
    residuals: FiniteOrNone
    left_out: FiniteOrNone = None
    terms: FiniteOrNone = None
    step: FiniteOrNone = None
    readings: FiniteOrNone = None
    search: FiniteOrNone = None
