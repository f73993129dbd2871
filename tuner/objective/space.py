"""The free coefficients, their bounds and priors, and the search vector."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import expit

from sim_jax.sensing import MAX_CUTOFF
from tuner.config import CoefficientSettings, JobFile
from tuner.core.errors import ConfigError
from tuner.core.numerics import Array
from tuner.vehicle import ControllerFile, VehicleFile, check_value, initial_values
from tuner.vehicle.coefficient import Parameter
from tuner.vehicle.joint_prior import JointPrior
from tuner.vehicle.registry import COEFFICIENTS
from tuner.vehicle.vehicle import Size, scaled_to_size, size_of

STANDARD_SIZE = Size()
MIN_SLOPE = 1e-150
"""Least slope: the square of its inverse is still finite."""
START_MARGIN = 0.05
"""A start on a bound is moved inside by this share of the range."""
CUTOFF = "gyro_cutoff"


class Space:
    """The free coefficients and the map between them and an unbounded vector."""

    def __init__(
        self,
        parameters: Sequence[Parameter],
        fixed: Mapping[str, float],
        joint_prior: JointPrior | None = None,
        size: Size = STANDARD_SIZE,
    ) -> None:
        self.size = size
        self.parameters = tuple(parameters)
        self.fixed = dict(fixed)
        self.names = tuple(parameter.name for parameter in self.parameters)
        self.lower = np.array([p.scaled(p.lower) for p in self.parameters])
        self.width = np.array([p.scaled(p.upper) for p in self.parameters]) - self.lower
        self.stretch = self.width / 4.0 / np.array([p.unit_step for p in self.parameters])
        self.is_log = np.array([p.scale == "log" for p in self.parameters], bool)
        self.prior_mean = np.array([p.prior_mean for p in self.parameters])
        self.prior_sd = np.array([p.prior_sd for p in self.parameters])
        self.joint_prior = joint_prior
        self.joint_rows, self.joint_offset = np.zeros((0, len(self))), np.zeros(0)
        if joint_prior is not None:
            self.joint_rows, self.joint_offset = joint_prior.rows(self.parameters, self.fixed)
        self.prior_rows = np.vstack([np.diag(1.0 / self.prior_sd), self.joint_rows])

    def __len__(self) -> int:
        return len(self.parameters)

    @property
    def free(self) -> tuple[str, ...]:
        """The coefficients that the search moves, tied ones too."""
        return tuple(name for parameter in self.parameters for name in parameter.ratios)

    @property
    def initial(self) -> Array:
        """The start as a search vector, shape (K,)."""
        return self.vector_of({p.name: p.initial for p in self.parameters})

    def vector_of(self, values: Mapping[str, float]) -> Array:
        """Return the search vector (K,) of coefficient values, clipped just inside the bounds."""
        return self.vector_at(np.array([p.scaled(values[p.name]) for p in self.parameters]))

    def vector_at(self, scaled: Array) -> Array:
        """Return the search vector (*S, K) at scaled coordinates, just inside the bounds."""
        return self.at_share((scaled - self.lower) / self.width)

    def scaled(self, vector: ArrayLike) -> Array:
        """Return the scaled coordinates of search vectors (*S, K)."""
        return np.asarray(self.lower + self.width * self.share(vector))

    def prior_residuals(self, vector: ArrayLike) -> Array:
        """Return the priors' residuals (*S, R) at search vectors (*S, K).

        Those of each parameter's own prior, then of the joint one. Their derivatives by the scaled
        coordinates are ``prior_rows`` (R, K).
        """
        scaled = self.scaled(vector)
        own = (scaled - self.prior_mean) / self.prior_sd
        return np.concatenate([own, scaled @ self.joint_rows.T + self.joint_offset], axis=-1)

    def at(self, vector: ArrayLike) -> Array:
        """Return the parameters' values at search vectors (*S, K)."""
        scaled = self.scaled(vector)
        return np.asarray(np.where(self.is_log, np.exp(np.where(self.is_log, scaled, 0.0)), scaled))

    def values(self, vector: ArrayLike) -> dict[str, Array]:
        """Return every free coefficient's value (*S,), tied ones too; as of `at`."""
        values = self.at(vector)
        return {
            name: values[..., column] * ratio
            for column, parameter in enumerate(self.parameters)
            for name, ratio in parameter.ratios.items()
        }

    def numbers(self, vector: ArrayLike) -> dict[str, float]:
        """Return every free coefficient's value at a search vector (K,), tied ones too."""
        return {name: float(value) for name, value in self.values(vector).items()}

    def slopes(self, vector: ArrayLike) -> dict[str, Array]:
        """Return every free coefficient's derivatives (K,) by a search vector, tied ones too."""
        slope = np.where(self.is_log, self.at(vector), 1.0) * self.slope(np.asarray(vector))
        return {
            name: np.where(np.arange(len(self)) == column, ratio * slope, 0.0)
            for column, parameter in enumerate(self.parameters)
            for name, ratio in parameter.ratios.items()
        }

    def share(self, vector: ArrayLike) -> Array:
        """Return each scaled coordinate's place between its bounds at a search vector, 0..1."""
        return np.asarray(expit(np.asarray(vector) / self.stretch))

    def at_share(self, share: Array) -> Array:
        """Return the search vector (*S, K) at shares of the bounds' range, just inside them."""
        inside = np.clip(share, 1e-6, 1 - 1e-6)
        return np.asarray(np.log(inside / (1 - inside)) * self.stretch)

    def slope(self, vector: Array) -> Array:
        """Return dx/dz, the scaled coordinate's change with the search vector, shape (K,).

        It is never zero, not even so close to a bound that no number lies between.
        """
        share = self.share(vector)
        slope = self.width * share * (1 - share) / self.stretch
        return np.asarray(np.maximum(slope, MIN_SLOPE))


def space_of(
    vehicle: VehicleFile,
    controller: ControllerFile,
    job: JobFile,
    joint_prior: JointPrior | None = None,
    *,
    bypassed: Collection[str] = (),
    also_free: Collection[str] = (),
) -> Space:
    """Return the space of a job's free coefficients.

    Parameters
    ----------
    vehicle, controller
        Give the start values.
    job
        Gives free and fixed coefficients, bounds, priors and ties.
    joint_prior
        Result of ground measurements.
    bypassed
        Coefficients without effect on the job's flights: they stay as they are.
    also_free
        Coefficients that are free besides the usual ones.

    Raises
    ------
    ConfigError
        Nothing is free, bounds exclude or pin the start, a tie names a fixed coefficient, or a free
        coefficient belongs to something that does not fly.
    """
    free = _free_names(job, bypassed, also_free)
    values = initial_values(vehicle, controller, free)
    for name in free:
        if name not in values:
            section, key = COEFFICIENTS[name].place
            raise ConfigError(
                name,
                "is free, but what it belongs to does not fly",
                f"give {section}.{key} in the vehicle file, or fix it",
            )
    groups: dict[str, tuple[str, ...]] = {name: (name,) for name in free}
    for ties in job.ties:
        group = tuple(name for name in ties if name not in bypassed)
        tied = [name for name in group if name in free]
        if not tied:
            continue
        for name in group[1:]:
            if name in job.coefficients:
                what = f"'{name}' goes with '{group[0]}', and has bounds or a prior of its own"
                raise ConfigError("ties", what, f"give those of '{group[0]}'")
        if len(tied) < len(group):
            missing = next(name for name in group if name not in free)
            raise ConfigError(
                "ties", f"'{missing}' is tied to a free coefficient but fixed", "free it"
            )
        for name in group[1:]:
            groups.pop(name)
        groups[group[0]] = tuple(group)
    size = size_of(vehicle)
    bounded = _with_filter_bounded(job, controller, values) if CUTOFF in free else job
    parameters = [parameter_of(names, values, bounded, size) for names in groups.values()]
    fixed = {n: v for n, v in values.items() if n not in free}
    return Space(parameters, fixed, joint_prior, size)


def _with_filter_bounded(
    job: JobFile, controller: ControllerFile, values: Mapping[str, float]
) -> JobFile:
    """Return a job with the gyro filter's cut-off bounded below half the rate loop's rate.

    Raises
    ------
    ConfigError
        The job file asks for one.
    """
    given, half = job.coefficients.get(CUTOFF, CoefficientSettings()), controller.rate.rate / 2
    if given.upper is not None and given.upper >= half:
        what = f"its upper bound {given.upper:g} Hz is not below half of rate.rate ({half:g} Hz)"
        raise ConfigError(CUTOFF, what, "lower it")
    _, upper = COEFFICIENTS[CUTOFF].limits(values[CUTOFF])
    if given.upper is not None or upper < half:
        return job
    changed = given.replace(upper=MAX_CUTOFF * controller.rate.rate)
    return job.replace(coefficients={**job.coefficients, CUTOFF: changed})


def _free_names(
    job: JobFile, bypassed: Collection[str], also_free: Collection[str]
) -> tuple[str, ...]:
    wanted = {n for n, row in COEFFICIENTS.items() if row.free or n in also_free} - set(job.fixed)
    wanted = wanted if job.free is None else set(job.free)
    free = tuple(name for name in COEFFICIENTS if name in wanted and name not in bypassed)
    if not free:
        key = "fixed" if job.free is None else "free"
        what = "leaves no coefficient that acts on these flights free"
        raise ConfigError(key, what, "free at least one")
    return free


def extended(
    space: Space, names: Sequence[str], job: JobFile, values: Mapping[str, float]
) -> Space:
    """Return a space with more coefficients free, after those that it has.

    Parameters
    ----------
    space
        The space, in which they are not free.
    names
        Names of the coefficients.
    job
        Their bounds and priors.
    values
        Coefficient -> start value, of all in ``names``.
    """
    added = (parameter_of((name,), values, job, space.size) for name in names)
    fixed = {n: v for n, v in space.fixed.items() if n not in names}
    return Space((*space.parameters, *added), fixed, space.joint_prior, space.size)


def parameter_of(
    names: tuple[str, ...], values: Mapping[str, float], job: JobFile, size: Size
) -> Parameter:
    """Return the parameter of a coefficient and of those tied to it, by a job's settings."""
    name = names[0]
    row, start = scaled_to_size(COEFFICIENTS[name], size), values[name]
    given = job.coefficients.get(name, CoefficientSettings())
    scale = given.scale or row.scale
    bounded = given.lower is not None and given.upper is not None
    if row.scale == "log" and start <= 0 and not (scale == "linear" and bounded):
        raise ConfigError(
            name, f"starts at {start:g}, which has no logarithm", "give bounds and scale: linear"
        )
    lower, upper = row.limits(start)
    lower = lower if given.lower is None else given.lower
    upper = upper if given.upper is None else given.upper
    if scale == "log" and lower <= 0:
        raise ConfigError(name, f"lower bound {lower:g} has no logarithm", "use scale: linear")
    if lower >= upper:
        raise ConfigError(
            name, f"its lower bound {lower:g} is not below its upper bound {upper:g}", "widen them"
        )
    for bound in (given.lower, given.upper):
        if bound:  # bounds are never reached, so that zero is allowed for positive coefficients
            check_value(name, bound, f"bound of {name}")

    def scaled(value: float) -> float:
        return float(np.log(max(value, 1e-300))) if scale == "log" else value

    least, width = scaled(lower), scaled(upper) - scaled(lower)
    moved, initial, share = None, start, (scaled(start) - least) / width
    if not 1e-9 < share < 1.0 - 1e-9:
        inner = least + width * float(np.clip(share, START_MARGIN, 1.0 - START_MARGIN))
        moved, initial = start, float(np.exp(inner)) if scale == "log" else inner
    mean, sd, quarter = scaled(initial), row.prior_sd, 0.25 * (upper - lower)
    if scale != row.scale:  # a start of zero has no share of itself
        sd *= 1.0 / initial if scale == "log" else abs(initial) or quarter
    if given.prior is not None:
        if not lower <= given.prior.mean <= upper:
            what = f"its prior's mean {given.prior.mean:g} is not within {lower:g} to {upper:g}"
            raise ConfigError(name, what, "give bounds that hold it")
        mean = scaled(given.prior.mean)
        sd = given.prior.sd / given.prior.mean if scale == "log" else given.prior.sd
    return Parameter(
        name=name,
        ratios={other: values[other] / start if start else 1.0 for other in names},
        initial=initial,
        lower=lower,
        upper=upper,
        scale=scale,
        prior_mean=mean,
        prior_sd=sd,
        prior_given=given.prior is not None,
        unit_step=row.step if scale == row.scale else quarter,
        usual=row.prior_sd if row.scale == "linear" else 0.0,
        moved=moved,
    )
