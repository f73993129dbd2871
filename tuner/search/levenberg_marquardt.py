"""optimistix's Levenberg-Marquardt, stepped by hand for several starts at once.

The solver is put together as optimistix documents it: an `AbstractGaussNewton` made of a descent
(`DampedNewtonDescent`, which solves (JᵀJ + λ I) Δy = -Jᵀr by QR) and a search
(`ClassicalTrustRegion`, which accepts or rejects the point and sets λ = 1/step size). Its `init`,
`step` and `terminate` are called here rather than by `optimistix.least_squares`, because the
residuals of a step come from a kernel, outside the compiled step, and
because a user sees each iteration. What `fn` is and why it is linear: `tuner.search
.normal_equations`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from tuner.objective.batch import sums_at
from tuner.objective.criterion import Criterion, Point, SegmentSums
from tuner.objective.normal import Objective
from tuner.objective.space import Coordinates
from tuner.search.normal_equations import (
    LinearResiduals,
    linear_residuals,
    normal_equations,
    residuals_at,
)


class _LevenbergMarquardt(optimistix.AbstractGaussNewton[Any, Any, Any]):  # type: ignore[misc]
    """Levenberg-Marquardt that takes longer steps as soon as the model predicts well."""

    rtol: float = 1e-9
    atol: float = 1e-9
    norm: Any = optimistix.max_norm
    descent: Any = optimistix.DampedNewtonDescent()
    search: Any = optimistix.ClassicalTrustRegion(
        high_cutoff=0.7, low_cutoff=0.05, high_constant=5.0, low_constant=0.2
    )
    verbose: Any = eqx.field(static=True, default=lambda **_: None)


_SOLVER = _LevenbergMarquardt()
_NO_OPTIONS: dict[str, Any] = {}
_NO_TAGS: frozenset[object] = frozenset()


class Step(eqx.Module):
    """Where the solver stands after a step; with S starts, every array has S first.

    Attributes
    ----------
    point
        The best point so far.
    solver
        optimistix's state; its ``y_eval`` is the point to be tried next.
    sums
        The segments' sums at the point that was tried, gradient and Hessian included; None before.
    best
        Those at the best point.
    loss
        Scalar: the loss at the best point, per compared value.
    accepted
        Whether the tried point was better.
    damping
        λ of the next step, relative to the Hessian per compared value.
    still
        Whether optimistix's own `terminate` holds: the accepted point and its residuals differ
        from those before by less than 1e-9.
    promise
        Share of the loss at the best point by which its minimum would be lower, were the residuals
        linear: ½ gᵀH⁻¹g over the loss. Free of units and of damping.
    """

    point: Point
    solver: Any
    sums: SegmentSums | None
    best: SegmentSums | None
    loss: Float[Array, ""]
    accepted: Bool[Array, ""]
    damping: Float[Array, ""]
    still: Bool[Array, ""]
    promise: Float[Array, ""]


def _pack(point: Point) -> Array:
    return jnp.concatenate([point.coefficients, point.offsets.reshape(-1)])


def _unpack(packed: Array, like: Point) -> Point:
    count = len(like.coefficients)
    return Point(packed[:count], packed[count:].reshape(like.offsets.shape))


@eqx.filter_jit
def _init(parameters: Array, damping: Array) -> Any:
    """Return the solver's state before the first step, for S starts (S, P) and their λ (S,)."""

    def init(parameters: Array, damping: Array) -> Any:
        count = len(parameters)
        shapes = LinearResiduals(jnp.eye(count), jnp.zeros(count + 1), parameters)
        residual, _ = jax.eval_shape(residuals_at, parameters, shapes)
        state = _SOLVER.init(
            residuals_at, parameters, shapes, _NO_OPTIONS, residual, None, _NO_TAGS
        )
        return eqx.tree_at(lambda s: s.search_state.step_size, state, 1.0 / damping)

    return eqx.filter_vmap(init)(parameters, damping)


@eqx.filter_jit
def _step(
    space: Coordinates,
    flight: ArrayLike,
    step: Step,
    criterion: Criterion,
    free: ArrayLike,
) -> Step:
    """Take a step for S starts, whose sums are those at the points that are to be tried."""

    def advanced(before: Step) -> Step:
        assert before.sums is not None
        tried = _unpack(before.solver.y_eval, before.point)
        equations = normal_equations(space, flight, tried, criterion, before.sums)
        linear = linear_residuals(before.solver.y_eval, *equations, free)
        parameters, solver, _ = _SOLVER.step(
            residuals_at, _pack(before.point), linear, _NO_OPTIONS, before.solver, _NO_TAGS
        )
        still, _ = _SOLVER.terminate(
            residuals_at, parameters, linear, _NO_OPTIONS, solver, _NO_TAGS
        )
        accepted = solver.num_steps_since_acceptance == 0
        return Step(
            point=_unpack(parameters, before.point),
            solver=solver,
            sums=before.sums,
            best=jax.tree.map(
                lambda new, old: jnp.where(accepted, new, old), before.sums, before.best
            ),
            loss=solver.f_info.as_min(),
            accepted=accepted,
            damping=1.0 / solver.search_state.step_size,
            still=still,
            promise=_promise(solver.f_info),
        )

    after: Step = eqx.filter_vmap(advanced)(step)
    return after


def _promise(info: Any) -> Array:
    """Return the share of a loss that `linear_residuals` say can be gained: r is (L⁻¹g, rest)."""
    gain = 0.5 * jnp.sum(info.residual[:-1] ** 2)
    return gain / jnp.maximum(info.as_min(), 1e-300)


def begin(points: Point, damping: NDArray[np.float64] | None = None) -> Step:
    """Return where the solver stands before its first step from S points.

    Parameters
    ----------
    points
        The starts; their leaves have S first, and so has every array returned.
    damping
        (S,) λ of the first step, relative to the Hessian per compared value; 1 by default.
    """
    starts = len(points.coefficients)
    first = jnp.ones(starts) if damping is None else jnp.asarray(damping)
    return cast(
        Step,
        on_host(
            Step(
                point=points,
                solver=_init(jax.vmap(_pack)(points), first),
                sums=None,
                best=None,
                loss=jnp.full(starts, jnp.inf),
                accepted=jnp.ones(starts, bool),
                damping=first,
                still=jnp.zeros(starts, bool),
                promise=jnp.full(starts, jnp.inf),
            )
        ),
    )


def advance(objective: Objective, before: Step, criterion: Criterion, free: ArrayLike) -> Step:
    """Try one point for every start: keep those that are better, and propose the next.

    The points are flown here, or wherever the engine in force computes; the step itself,
    a small affair, is taken on one.

    Parameters
    ----------
    objective
        The problem.
    before
        What `begin` or the last call returned.
    criterion
        Horizon, scales, robust limit: may change without compiling again, but only at `begin`.
    free
        (K + offsets·N,) one for what may move, zero for what stays; changes only at `begin`.
    """
    sums = sums_at(objective, proposed(before), criterion)
    after = _step(
        objective.space.coordinates,
        np.asarray(objective.segments.flight),
        replace(before, sums=sums, best=sums if before.best is None else before.best),
        criterion,
        np.asarray(free),
    )
    return cast(Step, on_host(after))


def proposed(step: Step) -> Point:
    """Return the points (S) that are to be tried next."""
    return cast(Point, on_host(jax.vmap(_unpack)(jnp.asarray(step.solver.y_eval), step.point)))


def on_host(tree: Any) -> Any:
    """Return a pytree with numpy arrays: the same compiled step then serves every iteration."""
    return jax.tree.map(lambda leaf: np.asarray(leaf) if eqx.is_array(leaf) else leaf, tree)
