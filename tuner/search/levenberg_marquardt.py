"""Levenberg-Marquardt on normal equations: optimistix's solver, fed with a square problem."""

from __future__ import annotations

from typing import Any, TypeAlias, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Float

from tuner.coefficients import of_scope
from tuner.coefficients.space import Coordinates, Space
from tuner.objective.criterion import OFFSET_UNIT, Criterion, Point, SegmentSums
from tuner.objective.normal import Objective

_Before: TypeAlias = tuple[Point, Any, SegmentSums]
"""Best points, solver states and the sums at the points that these wanted to try."""
RIDGE = 1e-13
"""Relative to the largest diagonal element: keeps a singular Hessian factorisable."""


class Step(eqx.Module):
    """Where a solver stands after a step; with S starts, every leaf has S first.

    Attributes
    ----------
    point
        The best point so far.
    solver
        optimistix's own state.
    sums
        The segments' sums at the point that was tried, gradient and Hessian included; None before.
    loss
        Scalar: the loss at the best point, per compared value.
    accepted
        Whether the tried point was better.
    """

    point: Point
    solver: Any
    sums: SegmentSums | None
    loss: Float[Array, ""]
    accepted: Array


def total(
    space: Space | Coordinates,
    flight: ArrayLike,
    point: Point,
    criterion: Criterion,
    sums: SegmentSums,
) -> tuple[Array, Array, Array]:
    """Return loss, gradient (P,) and Hessian (P, P) over all segments, priors included.

    The parameters are the coefficients, then the flights' offsets, one kind after the other;
    everything is divided by the number of compared values, so that damping means the same at every
    horizon.

    Parameters
    ----------
    space
        Free coefficients and their priors.
    flight
        (F,) number of the flight that each segment belongs to.
    point, criterion, sums
        Where, in which terms, and what the segments contribute there.
    """
    count, (kinds, flights) = len(space), point.offsets.shape
    compared = jnp.maximum(sum(jnp.sum(n) for n in sums.counts.values()), 1.0)
    mean, sd = jnp.asarray(space.prior_mean), jnp.asarray(space.prior_sd)

    def prior(vector: Array) -> Array:
        return (space.scaled(vector) - mean) / sd * criterion.prior

    pull, slope = jax.jvp(prior, (point.coefficients,), (jnp.ones(count),))
    offset_pull = point.offsets / OFFSET_SD
    loss = jnp.sum(sums.loss) + 0.5 * (jnp.sum(pull**2) + jnp.sum(offset_pull**2))
    owner = (jnp.arange(flights)[:, None] == jnp.asarray(flight)).astype(sums.gradient.dtype)
    own_gradient = sums.gradient[count:] @ owner.T + offset_pull / OFFSET_SD
    gradient = jnp.concatenate(
        [jnp.sum(sums.gradient[:count], axis=-1) + slope * pull, own_gradient.ravel()]
    )
    shared = jnp.sum(sums.hessian[:count, :count], axis=-1) + jnp.diag(slope**2)
    across = (sums.hessian[:count, count:] @ owner.T).reshape(count, -1)
    own = sums.hessian[count:, count:] @ owner.T  # (kinds, kinds, N): a flight's own alone
    spread = own[:, :, :, None] * jnp.eye(flights)
    block = jnp.moveaxis(spread, 2, 1).reshape(kinds * flights, kinds * flights)
    block = block + jnp.eye(len(block)) / OFFSET_SD**2
    hessian = jnp.block([[shared, across], [across.T, block]])
    return loss / compared, gradient / compared, hessian / compared


(OFFSET_SD,) = {row.prior_sd / OFFSET_UNIT for row in of_scope("flight").values()}
"""Prior of an offset, in its unit of 10 ms or 0.01 rad/s: likelier small than large."""


def _pack(point: Point) -> Array:
    return jnp.concatenate([point.coefficients, point.offsets.reshape(-1)])


def _unpack(packed: Array, like: Point) -> Point:
    count = len(like.coefficients)
    return Point(packed[:count], packed[count:].reshape(like.offsets.shape))


def _square_problem(loss: Array, gradient: Array, hessian: Array, free: ArrayLike) -> Any:
    """Return a least-squares function with as many residuals as parameters, plus one.

    It knows one point alone, where its value and its derivative rule give residuals r and Jacobian
    J with ½|r|² the loss, Jᵀr its gradient and JᵀJ the Gauss-Newton Hessian: a solver takes the
    very step that it would take on all the residuals, without seeing them.
    """
    free = jnp.asarray(free)
    gradient = gradient * free
    hessian = hessian * free[:, None] * free[None] + jnp.diag(1.0 - free)
    ridge = RIDGE * jnp.max(jnp.diag(hessian))
    factor = jnp.linalg.cholesky(hessian + ridge * jnp.eye(len(free)))
    residual = jax.scipy.linalg.solve_triangular(factor, gradient, lower=True)
    rest = jnp.sqrt(jnp.maximum(2.0 * loss - residual @ residual, 0.0))
    value = jnp.concatenate([residual, rest[None]])

    @jax.custom_jvp
    def square(packed: Array) -> Array:
        return value + 0.0 * packed[0]

    @square.defjvp
    def derivative(_: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
        return value, jnp.concatenate([factor.T @ tangents[0], jnp.zeros(1, value.dtype)])

    return lambda packed, _: (square(packed), None)


class _Solver(optimistix.AbstractGaussNewton[Any, Any, Any]):  # type: ignore[misc]
    """Levenberg-Marquardt that takes longer steps as soon as the model predicts well."""

    rtol: float = 1e-9
    atol: float = 1e-9
    norm: Any = optimistix.max_norm
    descent: Any = optimistix.DampedNewtonDescent()
    search: Any = optimistix.ClassicalTrustRegion(
        high_cutoff=0.7, low_cutoff=0.05, high_constant=5.0, low_constant=0.2
    )
    verbose: Any = eqx.field(static=True, default=lambda **_: None)


_SOLVER = _Solver()


def _fresh(packed: Array, fn: Any) -> Any:
    """Return the solver's first state."""
    shape, _ = jax.eval_shape(lambda p: fn(p, None), packed)
    return _SOLVER.init(fn, packed, None, {}, shape, None, frozenset())


@eqx.filter_jit
def _begin(packed: Array, free: ArrayLike) -> Any:
    def one(packed: Array) -> Any:
        still = jnp.zeros_like(packed)
        fn = _square_problem(jnp.zeros(()), still, jnp.diag(still), free)
        return eqx.filter(_fresh(packed, fn), eqx.is_array)

    return eqx.filter_vmap(one)(packed)


@eqx.filter_jit
def _step(
    space: Coordinates, flight: ArrayLike, before: _Before, criterion: Criterion, free: ArrayLike
) -> Step:
    def one(point: Point, solver: Any, sums: SegmentSums) -> Step:
        tried = _unpack(solver.y_eval, point)
        fn = _square_problem(*total(space, flight, tried, criterion, sums), free)
        packed = _pack(point)
        static = eqx.filter(_fresh(packed, fn), eqx.is_array, inverse=True)
        new, state, _ = _SOLVER.step(fn, packed, None, {}, eqx.combine(solver, static), frozenset())
        accepted = state.num_steps_since_acceptance == 0
        arrays = eqx.filter(state, eqx.is_array)
        return Step(_unpack(new, point), arrays, sums, state.f_info.as_min(), accepted)

    after: Step = eqx.filter_vmap(one)(*before)
    return after


def begin(points: Point, free: ArrayLike) -> Step:
    """Set a stage up at S points; their leaves have S first, and so has every leaf returned.

    Parameters
    ----------
    points
        Where the starts stand.
    free
        (K + offsets·N,) one for what may move, zero for what stays.
    """
    starts = len(points.coefficients)
    solver = _begin(jax.vmap(_pack)(points), np.asarray(free))
    fresh = Step(points, solver, None, jnp.full(starts, jnp.inf), jnp.ones(starts, bool))
    return cast(Step, on_host(fresh))


def advance(objective: Objective, before: Step, criterion: Criterion, free: ArrayLike) -> Step:
    """Try one point for every start: keep those that are better, and propose the next.

    The points are flown on all devices; the step itself, a small affair, is taken on one.

    Parameters
    ----------
    objective
        The problem.
    before
        What `begin` or the last call returned.
    criterion
        Horizon, scales, robust limit: may change without compiling again, but only at `begin`.
    free
        As given to `begin`.
    """
    tried = jax.vmap(_unpack)(jnp.asarray(before.solver.y_eval), before.point)
    after = _step(
        objective.space.coordinates,
        np.asarray(objective.segments.flight),
        (before.point, before.solver, objective.sums_of(on_host(tried), criterion)),
        criterion,
        np.asarray(free),
    )
    return cast(Step, on_host(after))


def on_host(tree: Any) -> Any:
    """Return a pytree with numpy leaves: the same compiled step then serves every iteration.

    What comes back from several devices would otherwise count as another kind of argument.
    """
    return jax.tree.map(np.asarray, tree)
