"""Where a selection of terms stands, and what it ends with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from tuner.job.prepare import Job
from tuner.search.fitted import Fitted
from tuner.selection.candidates import Groups
from tuner.selection.linear import Linear
from tuner.selection.table import SelectionRow


@dataclass(frozen=True)
class Selected:
    """A job and its fit with the terms that were kept, and the table of all that were tried.

    Attributes
    ----------
    in_doubt
        Coefficient -> how far it would move, in the scaled coordinate, with terms that were tried
        and not kept; empty where none was tried.
    """

    job: Job
    fitted: Fitted
    rows: tuple[SelectionRow, ...] = ()
    in_doubt: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Standing:
    """A fit with some groups in it, seen in linear approximation by all that could be in it.

    Attributes
    ----------
    fitted
        The fit; coefficients that only fill its space up stay at their neutral values.
    added
        Groups in it.
    linear
        The loss about it, by the base model's coefficients and all candidates.
    """

    fitted: Fitted
    added: Groups
    linear: Linear

    @property
    def vector(self) -> dict[str, float]:
        """Coefficient -> number of the search vector."""
        names, numbers = self.fitted.objective.space.names, self.fitted.point.coefficients
        return dict(zip(names, np.asarray(numbers).tolist(), strict=True))
