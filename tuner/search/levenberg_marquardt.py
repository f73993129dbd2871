"""Levenberg-Marquardt on normal equations: optimistix's solver, fed with a square problem."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Float

from tuner.objective.normal import LaneSums, Objective, Point, Stage

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
        The lanes' sums at the point that was tried, gradient and Hessian included.
    loss
        Scalar: the loss at the best point, per compared value.
    accepted
        Whether the tried point was better.
    """

    point: Point
    solver: Any
    sums: LaneSums
    loss: Float[Array, ""]
    accepted: Array


def total(
    objective: Objective, point: Point, stage: Stage, sums: LaneSums
) -> tuple[Array, Array, Array]:
    """Return loss, gradient (P,) and Hessian (P, P) over all lanes, priors and offsets included.

    The parameters are the coefficients, then the offsets clock by clock; everything is divided by
    the number of compared values, so that damping means the same at every horizon.
    """
    space, count = objective.space, len(objective.space)
    clocks, lanes = point.offsets.shape
    compared = jnp.maximum(sum(jnp.sum(n) for n in sums.counts.values()), 1.0)
    mean, sd = jnp.asarray(space.prior_mean), jnp.asarray(space.prior_sd)

    def prior(vector: Array) -> Array:
        return (space.scaled(vector) - mean) / sd * stage.prior

    pull, slope = jax.jvp(prior, (point.coefficients,), (jnp.ones(count),))
    clock_pull = point.offsets / OFFSET_SD
    loss = jnp.sum(sums.loss) + 0.5 * (jnp.sum(pull**2) + jnp.sum(clock_pull**2))
    size = count + clocks * lanes
    gradient, hessian = jnp.zeros(size), jnp.zeros((size, size))
    gradient = gradient.at[:count].set(jnp.sum(sums.gradient[:count], axis=-1) + slope * pull)
    shared = jnp.sum(sums.hessian[:count, :count], axis=-1) + jnp.diag(slope**2)
    hessian = hessian.at[:count, :count].set(shared)
    for clock in range(clocks):
        own = count + clock * lanes + jnp.arange(lanes)
        gradient = gradient.at[own].set(
            sums.gradient[count + clock] + clock_pull[clock] / OFFSET_SD
        )
        across = sums.hessian[:count, count + clock]
        hessian = hessian.at[:count, own].set(across).at[own, :count].set(across.T)
        for other in range(clocks):
            theirs = count + other * lanes + jnp.arange(lanes)
            hessian = hessian.at[own, theirs].set(sums.hessian[count + clock, count + other])
        hessian = hessian.at[own, own].add(1.0 / OFFSET_SD**2)
    return loss / compared, gradient / compared, hessian / compared


OFFSET_SD = 2.0
"""Prior of a clock's offset, in its unit of 10 ms: an offset is likelier small than large."""


def _pack(point: Point) -> Array:
    return jnp.concatenate([point.coefficients, point.offsets.reshape(-1)])


def _unpack(objective: Objective, packed: Array) -> Point:
    count = len(objective.space)
    return Point(packed[:count], packed[count:].reshape(-1, objective.lanes.count))


def _square_problem(objective: Objective, stage: Stage, free: ArrayLike) -> Any:
    """Return a least-squares function with as many residuals as parameters, plus one.

    Its derivative rule gives residuals r and Jacobian J with ½|r|² the loss, Jᵀr its gradient and
    JᵀJ the Gauss-Newton Hessian: a solver takes the very steps that it would take on all the
    residuals, without seeing them. Evaluated alone, it costs one simulation.
    """
    free = jnp.asarray(free)

    def evaluate(packed: Array, *, derivatives: bool) -> tuple[Array, Array, Array, LaneSums]:
        point = _unpack(objective, packed)
        sums = objective.sums(point, stage, derivatives=derivatives)
        return (*total(objective, point, stage, sums), sums)

    @jax.custom_jvp
    def square(packed: Array) -> tuple[Array, LaneSums]:
        loss, _, _, sums = evaluate(packed, derivatives=False)
        last = jnp.sqrt(2.0 * loss)
        return jnp.concatenate([jnp.zeros_like(packed), last[None]]), sums

    @square.defjvp
    def derivative(
        primals: tuple[Array], tangents: tuple[Array]
    ) -> tuple[tuple[Array, LaneSums], tuple[Array, LaneSums]]:
        (packed,), (change,) = primals, tangents
        loss, gradient, hessian, sums = evaluate(packed, derivatives=True)
        gradient = gradient * free
        hessian = hessian * free[:, None] * free[None] + jnp.diag(1.0 - free)
        ridge = RIDGE * jnp.max(jnp.diag(hessian))
        factor = jnp.linalg.cholesky(hessian + ridge * jnp.eye(len(packed)))
        residual = jax.scipy.linalg.solve_triangular(factor, gradient, lower=True)
        rest = jnp.sqrt(jnp.maximum(2.0 * loss - residual @ residual, 0.0))
        pushed = jnp.concatenate([factor.T @ change, jnp.zeros(1, packed.dtype)])
        quiet = jax.tree.map(jnp.zeros_like, sums)
        return (jnp.concatenate([residual, rest[None]]), sums), (pushed, quiet)

    return lambda packed, _: square(packed)


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


def _fresh(
    objective: Objective, point: Point, stage: Stage, free: ArrayLike
) -> tuple[Any, Any, Any]:
    """Return the function, the solver's first state, and the shape of what it reports."""
    fn = _square_problem(objective, stage, free)
    packed = _pack(point)
    shape, report = jax.eval_shape(lambda p: fn(p, None), packed)
    return fn, _SOLVER.init(fn, packed, None, {}, shape, report, frozenset()), report


def _begin(objective: Objective, point: Point, stage: Stage, free: ArrayLike) -> Step:
    _, state, report = _fresh(objective, point, stage, free)
    sums = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), report)
    arrays = eqx.filter(state, eqx.is_array)
    return Step(point, arrays, sums, jnp.asarray(jnp.inf), jnp.asarray(True))


def _advance(objective: Objective, before: Step, stage: Stage, free: ArrayLike) -> Step:
    fn, template, _ = _fresh(objective, before.point, stage, free)
    state = eqx.combine(before.solver, eqx.filter(template, eqx.is_array, inverse=True))
    packed = _pack(before.point)
    new, state, sums = _SOLVER.step(fn, packed, None, {}, state, frozenset())
    arrays = eqx.filter(state, eqx.is_array)
    accepted = state.num_steps_since_acceptance == 0
    return Step(_unpack(objective, new), arrays, sums, state.f_info.as_min(), accepted)


@eqx.filter_jit
def begin(objective: Objective, points: Point, stage: Stage, free: ArrayLike) -> Step:
    """Set a stage up at S points; their leaves have S first, and so has every leaf returned."""
    step: Step = eqx.filter_vmap(lambda point: _begin(objective, point, stage, free))(points)
    return step


@eqx.filter_jit
def advance(objective: Objective, before: Step, stage: Stage, free: ArrayLike) -> Step:
    """Try one point for every start: keep those that are better, and propose the next.

    Parameters
    ----------
    objective
        The problem.
    before
        What `begin` or the last call returned.
    stage
        Horizon, scales, robust limit: may change without compiling again, but only at `begin`.
    free
        (K + clocks·F,) one for what may move, zero for what stays.
    """
    after: Step = eqx.filter_vmap(lambda step: _advance(objective, step, stage, free))(before)
    return after
