"""Fisher information of innovations and of the closed loop, with the disturbances' strengths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tuner.core.numerics import scaled_solve
from tuner.disturbances.disturbances import LEAST, MOST, STRENGTHS
from tuner.objective.information import FisherInformation
from tuner.objective.inlets import INLETS

Array = NDArray[np.float64]

USUALLY = 1.5
"""Standard deviation a priori of a strength's logarithm about what it is learnt to be: what says
nothing of a strength says nothing against a coefficient."""


def hidden(names: Sequence[str]) -> NDArray[np.bool_]:
    """Return (K,) which coefficients recorded set-points hide: what lies upstream of them.

    And how high the markers sit: a loop holds its height to the millimetre, whereas a filter
    begins at the height of the first sample.
    """
    return np.isin(names, [*INLETS["body_rate"].bypasses, "marker_offset_z"])


def with_hidden(
    predicted: FisherInformation, looped: FisherInformation, names: Sequence[str], fitted: int
) -> FisherInformation:
    """Return what innovations say, and of what set-points hide what least squares said of it.

    That is what it said while all others were estimated too: given what the filter says of these,
    gusts would scatter it more (no noise model knows them there).

    Parameters
    ----------
    predicted, looped
        Of innovations, and of the closed loop's simulation, in the same channels.
    names, fitted
        Of the K coefficients, of which the first were fitted.
    """
    upstream = hidden(names)
    others = np.flatnonzero(~upstream[:fitted])
    upper = looped.total[np.ix_(others, np.flatnonzero(upstream))]
    clear = np.eye(len(names))
    clear[np.ix_(np.flatnonzero(upstream), others)] = -scaled_solve(
        looped.total[np.ix_(others, others)], upper
    ).T
    blocks = clear @ looped.blocks @ clear.T
    return replace(
        predicted,
        blocks=predicted.blocks + np.where(np.outer(upstream, upstream), blocks, 0.0),
        score=predicted.score + np.where(upstream, looped.score @ clear.T, 0.0),
        changes={
            name: change + np.where(upstream, looped.changes[name] @ clear.T, 0.0)
            for name, change in predicted.changes.items()
        },
    )


def with_strengths(
    information: FisherInformation, of_strengths: Array, strengths: Array
) -> FisherInformation:
    """Return what innovations say of coefficients while the disturbances' strengths are learnt too.

    With the strengths as they are innovations would know some coefficients better than they do: how
    quickly a vehicle turns against how strongly turbulence turns it, above all. Eliminated like all
    that is estimated beside them, the strengths take A B⁻¹ Aᵀ from the information of all flights,
    A what innovations say of both together and B what they say of the strengths.

    Parameters
    ----------
    information
        With the strengths among its changes.
    of_strengths
        (7, 7) B, the innovations' covariance included.
    strengths
        (7,) logarithms: one at its limit is not learnt.
    """
    learnt = np.flatnonzero((strengths > LEAST) & (strengths < MOST))
    changes = dict(information.changes)
    across = np.array([changes.pop(name).sum(axis=0) for name in STRENGTHS])[learnt]
    own = of_strengths[np.ix_(learnt, learnt)] + np.eye(len(learnt)) / USUALLY**2
    return replace(information, lost=across.T @ scaled_solve(own, across), changes=changes)
