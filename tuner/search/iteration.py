"""Records of a search: its iterations, the ends of its starts, and its estimates."""

from __future__ import annotations

from tuner.core.files import FiniteOrNone, Part


class Iteration(Part):
    """One step of a search.

    Attributes
    ----------
    stage
        Name of the stage of the continuation.
    number
        Counts all iterations of the search.
    loss
        Half the mean squared residual after the step, in (scaled) standard deviations.
    position_rmse
        m, over all fitted flights up to the horizon, at the point tried; None where no position
        is compared.
    accepted
        Whether the step was kept.
    horizon
        s.
    damping
        λ of the Levenberg-Marquardt step that follows, relative to the Hessian per compared value;
        None for CMA-ES.
    """

    stage: str
    number: int
    loss: float
    position_rmse: FiniteOrNone
    accepted: bool
    horizon: float
    damping: FiniteOrNone = None


class Outcome(Part):
    """The end of one start of a search.

    Attributes
    ----------
    origin
        ``vehicle file`` or ``random``.
    loss
        At the end, on whole flights, in the final weights.
    start, end
        Coefficient -> value at the beginning and at the end, in its unit.
    """

    origin: str
    loss: FiniteOrNone
    start: dict[str, float]
    end: dict[str, float]


class PointEstimate(Part):
    """A coefficient where a search ended.

    Attributes
    ----------
    name
        Of the coefficient.
    unit
        Of both numbers.
    initial
        Value in the vehicle or controller file.
    estimate
        Value where the search ended.
    """

    name: str
    unit: str
    initial: float
    estimate: float
