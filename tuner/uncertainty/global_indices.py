"""Global sensitivity: which coefficients matter anywhere between their bounds.

Morris' elementary effects (Morris, "Factorial sampling plans for preliminary computational
experiments", 1991) or Sobol's indices (Sobol, "Global sensitivity indices for nonlinear
mathematical models and their Monte Carlo estimates", 2001; Saltelli et al., 2010), as SALib
computes them, of the logarithm of each channel's RMSE.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tuner.objective.batch import evaluate
from tuner.objective.criterion import Criterion, Point
from tuner.objective.normal import Objective
from tuner.uncertainty.records import (
    GlobalSensitivity,
    Method,
    SensitivityIndex,
)

Array = NDArray[np.float64]

LEVELS = 4
"""Number of levels of Morris' grid."""
FLOOR = 1e-3
"""Lower limit of an RMSE in standard deviations, below which its logarithm means nothing."""
SAMPLES = {"morris": 16, "sobol": 64}
"""Default number of trajectories, or base points; each coefficient adds so many simulations."""


def global_sensitivity(
    objective: Objective,
    point: Point,
    criterion: Criterion,
    *,
    method: Method,
    flights: Sequence[str],
    bounds: Mapping[str, tuple[float, float]],
    samples: int | None = None,
    seed: int = 0,
) -> GlobalSensitivity:
    """Return each coefficient's index for every channel of every flight, and for their mean.

    Parameters
    ----------
    objective, point, criterion
        The problem; of the point only the offsets matter.
    method
        ``morris`` or ``sobol``.
    flights
        Names by number.
    bounds
        Coefficient -> between which values it is varied.
    samples
        Trajectories of Morris, base points of Sobol (rounded up to a power of two).
    seed
        Of the sampling.
    """
    space = objective.space
    problem = {
        "num_vars": len(space),
        "names": list(space.names),
        "bounds": [[p.scaled(end) for end in bounds[p.name]] for p in space.parameters],
    }
    count = samples or SAMPLES[method]
    points = _samples(problem, method, count, seed)
    batch = evaluate(objective, space.vector_at(points), point, criterion)
    crashed = np.isfinite(np.asarray(batch.crash_time))
    outputs, values = _outputs(objective, batch.squares, crashed, flights)
    indices = []
    for (flight, channel), column in zip(outputs, values.T, strict=True):
        indices += _indices(problem, method, points, column, seed, flight=flight, channel=channel)
    return GlobalSensitivity(
        method=method,
        bounds={name: bounds[name] for name in space.names},
        simulations=len(points),
        crashed=int(crashed.any(axis=1).sum()),
        indices=indices,
    )


def _samples(problem: dict[str, Any], method: Method, count: int, seed: int) -> Array:
    """Return the sampled scaled coordinates (S, K)."""
    if method == "morris":
        from SALib.sample import morris  # noqa: PLC0415 (pandas and scipy)

        return np.asarray(morris.sample(problem, count, num_levels=LEVELS, seed=seed))
    from SALib.sample import sobol  # noqa: PLC0415

    power = 2 ** int(np.ceil(np.log2(max(count, 2))))
    return np.asarray(sobol.sample(problem, power, calc_second_order=False, seed=seed))


def _outputs(
    objective: Objective, squares: Any, crashed: NDArray[np.bool_], flights: Sequence[str]
) -> tuple[list[tuple[str, str]], Array]:
    """Return (flight, channel) of R outputs and the logarithm of their RMSE, (S, R).

    A simulation that crashed on a flight counts as no better than the worst that flew it.
    """
    flight = objective.flight
    names, columns = [], []
    for number, name in enumerate(flights):
        segments = np.flatnonzero(flight == number)
        crashed_here = crashed[:, segments].any(axis=1)
        for channel, measured in objective.segments.measured.items():
            count = int((np.asarray(measured.weight)[..., segments] > 0).sum())
            if count == 0:
                continue
            total = np.asarray(squares[channel])[..., segments].sum(axis=(1, 2))
            rms = np.sqrt(total / count)
            usable = np.isfinite(rms)
            worst = float(rms[usable & ~crashed_here].max(initial=FLOOR))
            rms = np.where(usable, rms, worst)
            rms = np.where(crashed_here, np.maximum(rms, worst), rms)
            names.append((name, channel))
            columns.append(np.log10(np.maximum(rms, FLOOR)))
    table = np.stack(columns, axis=-1)
    return [("", ""), *names], np.column_stack([table.mean(axis=1), table])


def _indices(
    problem: dict[str, Any],
    method: Method,
    points: Array,
    values: Array,
    seed: int,
    *,
    flight: str,
    channel: str,
) -> list[SensitivityIndex]:
    if np.ptp(values) == 0.0:
        main = total = spread = np.zeros(len(problem["names"]))
    elif method == "morris":
        from SALib.analyze import morris  # noqa: PLC0415

        analysis = morris.analyze(problem, points, values, num_levels=LEVELS, seed=seed)
        main, total, spread = analysis["mu"], analysis["mu_star"], analysis["sigma"]
    else:
        from SALib.analyze import sobol  # noqa: PLC0415

        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # an output that hardly varies
            # SALib takes a seed of 0 for none
            analysis = sobol.analyze(problem, values, calc_second_order=False, seed=seed + 1)
        main, total, spread = analysis["S1"], analysis["ST"], analysis["ST_conf"]
    return [
        SensitivityIndex(
            coefficient=name,
            flight=flight,
            channel=channel,
            main=float(np.nan_to_num(main[i])),
            total=float(np.nan_to_num(total[i])),
            spread=float(np.nan_to_num(spread[i])),
        )
        for i, name in enumerate(problem["names"])
    ]
