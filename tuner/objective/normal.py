"""Cost, gradient and Gauss-Newton Hessian of a fit, lane by lane, without keeping a Jacobian."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from sim_jax.crash import Limits
from sim_jax.schedule import Schedule
from tuner.coefficients import Space
from tuner.model import Model, with_coefficients
from tuner.objective.lanes import CLOCKS, Lanes
from tuner.objective.residuals import Trace, fly, residuals
from tuner.parallel import over_devices

OFFSET_UNIT = 0.01
"""s of clock offset per unit of the search's coordinate."""


class Point(eqx.Module):
    """Where the search is: what all lanes share, and each lane's own.

    Attributes
    ----------
    coefficients
        (K,) search vector of the `Space`.
    offsets
        (clocks, F) clock offsets in units of `OFFSET_UNIT`.
    """

    coefficients: Float[Array, " K"]
    offsets: Float[Array, "clocks F"]


class Stage(eqx.Module):
    """What changes from one stage of the search to the next, without compiling again.

    Attributes
    ----------
    horizon
        Samples of the simulation that are compared.
    scale
        Channel -> (F,) factor on the standard deviations: loosened at first, more for a lane that
        the model cannot match.
    held
        (clocks, F) s of clock offset for the signals that jump between samples.
    huber
        Residuals beyond so many (scaled) standard deviations count linearly; infinite for plain
        squares.
    prior
        Factor on the prior's residuals.
    """

    horizon: Int[Array, ""]
    scale: dict[str, Float[Array, " F"]]
    held: Float[Array, "clocks F"]
    huber: Float[Array, ""]
    prior: Float[Array, ""]


class LaneSums(eqx.Module):
    """What one lane contributes; P = K + clocks.

    Attributes
    ----------
    loss
        (F,) half the robust sum of squares.
    gradient, hessian
        (P, F) and (P, P, F); zero where derivatives were not asked for.
    squares
        Channel -> (F,) plain sum of squares in unscaled standard deviations.
    counts
        Channel -> (F,) how many values were compared.
    crash_time
        (F,) s.
    """

    loss: Float[Array, " F"]
    gradient: Float[Array, "P F"]
    hessian: Float[Array, "P P F"]
    squares: dict[str, Float[Array, " F"]]
    counts: dict[str, Float[Array, " F"]]
    crash_time: Float[Array, " F"]


class Jacobian(eqx.Module):
    """Every residual and its derivatives at a point; P = K + clocks.

    It holds P numbers for every recorded one: some 10 MB for a flight of 40 s.

    Attributes
    ----------
    residuals
        Channel -> (n, k, F), in unscaled standard deviations.
    columns
        Channel -> (P, n, k, F): derivatives by the search vector, then by each clock's offset in
        units of `OFFSET_UNIT`.
    crash_time
        (F,) s.
    """

    residuals: dict[str, Float[Array, "n k F"]]
    columns: dict[str, Float[Array, "P n k F"]]
    crash_time: Float[Array, " F"]


class Objective(eqx.Module):
    """A fit as a function of a point: data and model are leaves, so that it compiles once a shape.

    Attributes
    ----------
    model
        Fixed coefficients and the controllers.
    lanes
        The data.
    space
        Free coefficients.
    schedule, samples, limits
        How the simulation runs.
    """

    model: Model
    lanes: Lanes
    space: Space = eqx.field(static=True)
    schedule: Schedule = eqx.field(static=True)
    samples: int = eqx.field(static=True)
    limits: Limits = eqx.field(static=True)

    def start(self, vector: np.ndarray[Any, Any]) -> Point:
        """Return a point with a search vector and no clock offset."""
        clocks = jnp.zeros((len(CLOCKS), self.lanes.count))
        return Point(jnp.asarray(vector), clocks)

    @property
    def flier(self) -> Flier:
        """The static half, by which compiled functions are kept."""
        return Flier(self.space, self.schedule, self.samples, self.limits)

    def simulate(self, coefficients: Float[Array, " K"], horizon: Int[Array, ""]) -> Trace:
        """Fly every lane with a search vector."""
        return self.flier.fly(self.model, self.lanes, coefficients, horizon)

    def sums(self, point: Point, stage: Stage, *, derivatives: bool) -> LaneSums:
        """Return every lane's contribution, computed on all devices."""
        return _shared_sums(self.flier, derivatives)(
            (self.lanes, point.offsets, stage.scale, stage.held),
            self.model,
            point.coefficients,
            stage.horizon,
            stage.huber,
        )

    def jacobian(self, point: Point, stage: Stage) -> Jacobian:
        """Return every residual's derivatives, computed on all devices."""
        return _shared_jacobian(self.flier)(
            (self.lanes, point.offsets, stage.held), self.model, point.coefficients, stage.horizon
        )


@lru_cache(maxsize=16)
def _shared_jacobian(flier: Flier) -> Callable[..., Jacobian]:
    return jax.jit(over_devices(flier.jacobian))


@lru_cache(maxsize=16)
def _shared_sums(flier: Flier, derivatives: bool) -> Callable[..., LaneSums]:
    """Return the sums over all devices, traced once however often they are used."""

    def lanewise(data: Any, *rest: Any) -> LaneSums:
        return flier.sums(data, *rest, derivatives=derivatives)

    return jax.jit(over_devices(lanewise))


@dataclass(frozen=True)
class Flier:
    """The static half of an objective: its methods are functions of arrays alone."""

    space: Space
    schedule: Schedule
    samples: int
    limits: Limits

    def fly(self, model: Model, lanes: Lanes, coefficients: Array, horizon: Array) -> Trace:
        """Simulate some lanes with a search vector (K,) up to a horizon in samples."""
        return fly(
            with_coefficients(model, self.space.values(coefficients)),
            lanes,
            self.schedule,
            samples=self.samples,
            horizon=horizon,
            limits=self.limits,
        )

    def compared(
        self, data: tuple[Lanes, Array, Array], model: Model, coefficients: Array, horizon: Array
    ) -> tuple[Trace, dict[str, Array]]:
        """Return the simulation and channel -> (n, k, F) residuals in standard deviations."""
        lanes, offsets, held = data
        trace = self.fly(model, lanes, coefficients, horizon)
        rate = float(self.schedule.log_rate)
        late = offsets * OFFSET_UNIT
        return trace, residuals(trace, lanes, late, held, rate=rate, horizon=horizon)

    def sums(
        self,
        data: tuple[Lanes, Array, dict[str, Array], Array],
        model: Model,
        coefficients: Array,
        horizon: Array,
        huber: Array,
        *,
        derivatives: bool,
    ) -> LaneSums:
        """Return what some lanes contribute; see `Objective.sums`."""
        lanes, offsets, scale, held = data
        rate = float(self.schedule.log_rate)

        def simulate(vector: Array) -> Trace:
            return self.fly(model, lanes, vector, horizon)

        def compare(trace: Trace, clocks: Array) -> dict[str, Array]:
            return residuals(trace, lanes, clocks * OFFSET_UNIT, held, rate=rate, horizon=horizon)

        if derivatives:
            trace, moved = _jacobian_forward(simulate, coefficients)
        else:
            trace, moved = simulate(coefficients), None
        errors = compare(trace, offsets)
        squares = {name: jnp.sum(e * e, axis=(0, 1)) for name, e in errors.items()}
        counts = {name: _count(lanes, name, rate, horizon) for name in errors}
        scaled = {name: e / scale[name] for name, e in errors.items()}
        loss = sum((jnp.sum(robust(e, huber), axis=(0, 1)) for e in scaled.values()), jnp.zeros(()))
        lanes_here = offsets.shape[-1]
        size = len(coefficients) + len(offsets)
        gradient, hessian = jnp.zeros((size, lanes_here)), jnp.zeros((size, size, lanes_here))
        if moved is not None:
            columns = _columns(compare, trace, moved, offsets)
            gradient, hessian = _normal(columns, scaled, scale, huber)
        return LaneSums(0.5 * loss, gradient, hessian, squares, counts, trace.crash_time)

    def jacobian(
        self, data: tuple[Lanes, Array, Array], model: Model, coefficients: Array, horizon: Array
    ) -> Jacobian:
        """Return every residual of some lanes and its derivatives."""
        lanes, offsets, held = data
        rate = float(self.schedule.log_rate)

        def compare(trace: Trace, clocks: Array) -> dict[str, Array]:
            return residuals(trace, lanes, clocks * OFFSET_UNIT, held, rate=rate, horizon=horizon)

        trace, moved = _jacobian_forward(
            lambda vector: self.fly(model, lanes, vector, horizon), coefficients
        )
        columns = _columns(compare, trace, moved, offsets)
        return Jacobian(compare(trace, offsets), columns, trace.crash_time)


def _jacobian_forward(simulate: Any, vector: Array) -> tuple[Trace, Trace]:
    """Return a simulation and its derivative to every element of a vector, (K, ...) first."""

    def push(direction: Array) -> tuple[Trace, Trace]:
        flown, moved = jax.jvp(simulate, (vector,), (direction,))
        return flown, moved

    pushed: tuple[Trace, Trace] = jax.vmap(push, out_axes=(None, 0))(
        jnp.eye(len(vector), dtype=vector.dtype)
    )
    return pushed


def _columns(compare: Any, trace: Trace, moved: Trace, offsets: Array) -> dict[str, Array]:
    """Return channel -> (P, n, k, F): derivatives by coefficients, then by each clock's offset.

    A clock's offset does not enter the simulation, so that its column costs an interpolation.
    """
    by_coefficient = jax.vmap(
        lambda change: jax.jvp(lambda flown: compare(flown, offsets), (trace,), (change,))[1]
    )(moved)
    clocks = offsets.shape[0]
    each = jnp.eye(clocks, dtype=offsets.dtype)[:, :, None] * jnp.ones_like(offsets)
    by_clock = jax.vmap(
        lambda change: jax.jvp(lambda late: compare(trace, late), (offsets,), (change,))[1]
    )(each)
    return {
        name: jnp.concatenate([by_coefficient[name], by_clock[name]]) for name in by_coefficient
    }


def _normal(
    columns: dict[str, Array], scaled: dict[str, Array], scale: dict[str, Array], huber: Array
) -> tuple[Array, Array]:
    gradient: Array = jnp.zeros(())
    hessian: Array = jnp.zeros(())
    for name, error in scaled.items():
        size = jnp.abs(error)
        weight = jnp.where(size > huber, huber / jnp.where(size > 0, size, 1.0), 1.0)
        column = columns[name] / scale[name]
        weighted = column * weight
        gradient = gradient + jnp.einsum("pnkf,nkf->pf", weighted, error)
        hessian = hessian + jnp.einsum("pnkf,qnkf->pqf", weighted, column)
    return gradient, hessian


def robust(error: Array, limit: Array) -> Array:
    """Return Huber's loss of an error: its square, growing linearly beyond a limit."""
    size = jnp.abs(error)
    return jnp.where(size > limit, 2.0 * limit * size - limit * limit, error * error)


def _count(lanes: Lanes, name: str, rate: float, horizon: Array) -> Array:
    measured = lanes.measured[name]
    flown = measured.time * rate < horizon - 1
    return jnp.sum((measured.weight > 0) & flown[:, None], axis=(0, 1)).astype(float)
