"""Inverse regression: the inertia at which recorded motion and measured rotor speeds balance.

A simulation that is fed measured rotor speeds is fed their errors too: noise, and a drift within
seconds. Least squares on what comes out then shrinks what the rotors do, the more the noisier they
are, and raises the damping that stands in for it (errors in variables): it finds what predicts
these flights best with that noise, and takes inertia for larger than it is, the slower a flight the
more. A loop that flies makes it worse: rotors answer what disturbs the vehicle, and cancel it. Seen
from the other side there is no such bias: the motion is known well, what the rotors must have done
follows from it, and errors are in what they are said to have done (inverse regression; Fuller,
Measurement Error Models, 1987).

Newton's and Euler's equations are weighed with a smooth function φ over stretches of a window; its
derivative takes the place of accelerations, which nobody recorded (modulating functions, Shinbrot
1957). With R the attitude, F and M what acts, in body axes::

    ∫ φ (R F) dt + ∫ φ' m v dt - m g,     ∫ φ (M - ω x Iω) dt + ∫ φ' Iω dt

What is left, as a change of the rotors' squared speeds that would make up for it, is the residual.

All of the balance predicts badly where the measured speeds drift: nothing then damps what the drift
drives. So the balance settles how strongly rotors turn the vehicle, `TURNS`, and all else is fitted
again to what flies, drag of the turning above all. Every flight is left out in turn, and that is
taken unless what was left out is predicted much worse than by least squares alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from types import MappingProxyType

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike, NDArray

from sim_jax.constants import GRAVITY
from sim_jax.environment import Air
from sim_jax.frames import gyro_of, markers_of
from sim_jax.geometry import Quaternion, Vec3
from sim_jax.numeric import Array
from sim_jax.rigid_body import Motion
from sim_jax.state import AIRBORNE
from sim_jax.terms.total import total_wrench
from sim_jax.vehicle import PerRotor, Vehicle
from tuner.core.numerics import huber_weights, robust_sd, scaled_solve
from tuner.findings.findings import Code, Finding, Level
from tuner.objective.criterion import Point, SegmentSums
from tuner.objective.normal_equations import Objective, normal_equations, some_segments, sums_at
from tuner.objective.simulation import fly
from tuner.objective.space import Space
from tuner.recordings.flight import Flight
from tuner.recordings.states import states_at
from tuner.search.levenberg_marquardt import descend
from tuner.search.problem import Job
from tuner.search.progress import Fitted, Free, StageProblem
from tuner.search.stages import Stage
from tuner.uncertainty.examination import Examination, examine
from tuner.uncertainty.model_error import alternatives_of
from tuner.vehicle.model import Model, with_coefficients

STRETCH = 0.2
"""s that the equations are weighed over: noise beyond some 5 Hz is averaged out."""
FASTEST = 100
"""Hz at which the equations are evaluated, about."""


class Balance(eqx.Module):
    """Recorded motion of F windows at n times each, and what their rotors are said to have done.

    Attributes
    ----------
    motion
        Leaves (n, F).
    rotor_speed, rotor_acceleration
        rad/s and rad/s², each (n, F).
    weight, slope
        (S, n) φ of S stretches, its sum over the times 1, and φ' likewise, in 1/s.
    """

    motion: Motion
    rotor_speed: PerRotor
    rotor_acceleration: PerRotor
    weight: Float[Array, "S n"]
    slope: Float[Array, "S n"]

    @eqx.filter_jit
    def residuals(self, model: Model, space: Space, vector: ArrayLike) -> Float[Array, "6 S F"]:
        """Return what forces and moments lack, in squares of rotor speeds.

        Forces along the body's axes in the middle of each stretch, then moments about them; those
        about x and y stand for squares at an arm of a metre.
        """
        vehicle = with_coefficients(model, space.values(jnp.asarray(vector))).vehicle
        air = Air.around(vehicle, self.motion, rotor_acceleration=self.rotor_acceleration)
        acting = total_wrench(vehicle, self.motion, self.rotor_speed, air)
        force = self._force_lacking(vehicle, acting.force)
        moment = self._moment_lacking(vehicle, acting.moment)
        aerodynamics = vehicle.aerodynamics
        of_square = aerodynamics.motor_constant
        about_shaft = of_square * aerodynamics.moment_constant
        return jnp.concatenate(
            [force / of_square, moment[:2] / of_square, moment[2:] / about_shaft]
        )

    @eqx.filter_jit
    def jacobian(self, model: Model, space: Space, vector: ArrayLike) -> Float[Array, "6 S F K"]:
        """Return the residuals' derivatives by the search vector."""
        moved: Array = jax.jacfwd(lambda v: self.residuals(model, space, v))(jnp.asarray(vector))
        return moved

    def _force_lacking(self, vehicle: Vehicle, acting: Vec3) -> Array:
        """Return what Newton's equation lacks, (3, S, F) N."""
        attitude, mass = self.motion.attitude, vehicle.body.mass
        weight = jnp.asarray([0.0, 0.0, mass * GRAVITY])[:, None, None]
        lacking = (
            self._over(self.weight, attitude.to_world(acting))
            + mass * self._over(self.slope, self.motion.velocity)
            - weight
        )
        middle = jnp.argmax(self.weight, axis=1)
        there: Quaternion = jax.tree.map(lambda leaf: leaf[middle], attitude)
        return there.to_body(Vec3.of(lacking)).stacked()

    def _moment_lacking(self, vehicle: Vehicle, acting: Vec3) -> Array:
        """Return what Euler's equation lacks, (3, S, F) N m."""
        body, rate = vehicle.body, self.motion.body_rate
        momentum = rate.scaled_by(Vec3(body.inertia_xx, body.inertia_yy, body.inertia_zz))
        return self._over(self.weight, acting - rate.cross(momentum)) + self._over(
            self.slope, momentum
        )

    @staticmethod
    def _over(weights: Float[Array, "S n"], values: Vec3) -> Float[Array, "3 S F"]:
        return jnp.einsum("sn,anf->asf", weights, values.stacked())


def balance_of(objective: Objective, point: Point, flights: Sequence[Flight]) -> Balance:
    """Return the recorded motion in an objective's windows, and its rotors' speeds.

    Parameters
    ----------
    objective, point
        Windows from recorded states; where commands are fed in they turn the rotors as at the
        point.
    flights
        The fitted ones, in the objective's order.
    """
    step = max(1, objective.schedule.log_rate // FASTEST)
    rate, samples = objective.schedule.log_rate / step, -(-objective.samples // step)
    segments, flight = objective.segments, objective.flight
    time = segments.begins[:, None] + np.arange(samples) / rate
    columns: dict[str, NDArray[np.float64]] = {
        name: np.full((samples, size, segments.count), np.nan)
        for name, size in {"position": 3, "velocity": 3, "attitude": 4, "body_rate": 3}.items()
    }
    for number, recorded in enumerate(flights):
        windows = np.flatnonzero(flight == number)
        states = states_at(recorded.series, time[windows].ravel())
        for name, table in columns.items():
            rows = getattr(states, name).reshape(len(windows), samples, -1)
            table[..., windows] = np.moveaxis(rows, 0, -1)
    position, velocity, attitude, body_rate = (
        jnp.moveaxis(jnp.asarray(table), 1, 0) for table in columns.values()
    )
    model = objective.model_at(point.coefficients)
    logged = fly(
        model,
        segments,
        objective.schedule,
        samples=objective.samples,
        limits=AIRBORNE,
        channels=("rotor_speed",),
    ).channels["rotor_speed"]
    speeds = tuple(jnp.asarray(speed) for speed in logged.T[:, ::step])
    weight, slope = _smooth(samples, rate)
    return Balance(
        Motion(Vec3.of(position), Vec3.of(velocity), Quaternion.of(attitude), Vec3.of(body_rate)),
        speeds,
        tuple(jnp.asarray(np.gradient(speed, 1.0 / rate, axis=0)) for speed in speeds),
        weight,
        slope,
    )


def _smooth(samples: int, rate: float) -> tuple[Array, Array]:
    """Return Hann's window every half `STRETCH`, and its slope: (S, n) each."""
    count = round(STRETCH * rate)
    firsts = range(0, samples - count, max(1, count // 2))
    weight, slope = np.zeros((2, len(firsts), samples))
    phase = 2.0 * np.pi * np.arange(count + 1) / count
    for row, first in enumerate(firsts):
        weight[row, first : first + count + 1] = (1.0 - np.cos(phase)) / count
        slope[row, first : first + count + 1] = np.sin(phase) * 2.0 * np.pi / count * rate / count
    return jnp.asarray(weight), jnp.asarray(slope)


Vector = NDArray[np.float64]
Mask = NDArray[np.bool_]

STEPS = 10
"""Gauss-Newton steps; the equations are nearly linear."""
LONGEST_STEP = 1.0
"""Of a coordinate of the search."""
SETTLED = 1e-4
"""Step of a coordinate below which it has arrived."""
ROBUST = 3.0
"""Standard deviations beyond which a residual counts linearly."""
TURNS = ("inertia_xx", "inertia_yy", "inertia_zz", "moment_constant")
"""Coefficients that the balance settles."""
TOLERATED = 0.2
"""Share by which the loss of what was left out may be larger, a tenth in its residuals: least
squares gains so much from flights that are like each other, and loses it on others."""
LEFT_OUT = Stage("left out", 0, robust=True, steps=8, tolerance=1e-3)
"""From the fit to all, a fit to the others is a few steps away, or with other inertia."""
REPORT_ABOVE = 0.1
"""Share by which an inertia changes from which it is said."""


@dataclass(frozen=True)
class _Settling:
    """A fit, and the balance of its recordings."""

    fitted: Fitted
    balance: Balance

    def at(self, inside: Mask, begin: ArrayLike) -> Vector:
        """Return the search vector (K,) at which some windows (F,) balance, from a start.

        What does not act in the balance, the motors above all, stays as it is.
        """
        objective, vector = self.fitted.objective, np.array(begin, float)
        model, space = objective.model, objective.space
        residuals = np.asarray(self.balance.residuals(model, space, vector))
        inside = inside & np.isfinite(residuals).all(axis=(0, 1))
        held = np.isin(space.names, list(self.fitted.held.values()))
        for _ in range(STEPS):
            residuals = np.asarray(self.balance.residuals(model, space, vector))
            columns = np.asarray(self.balance.jacobian(model, space, vector))
            moves = (columns[:, :, inside] != 0.0).any(axis=(0, 1, 2)) & ~held
            gradient, hessian = self._normal_equations(vector, residuals, columns, inside)
            free = np.flatnonzero(moves)
            step = scaled_solve(hessian[np.ix_(free, free)], gradient[free])
            vector[free] -= np.clip(step, -LONGEST_STEP, LONGEST_STEP)
            if np.abs(step).max(initial=0.0) < SETTLED:
                break
        return vector

    def refitted(self, inside: Mask, balanced: Vector) -> Vector:
        """Return the search vector (K,) that meets some windows best with a balance's `TURNS`."""
        settled = np.isin(self.fitted.objective.space.names, TURNS)
        begin = np.where(settled, balanced, np.asarray(self.fitted.point.coefficients))
        return _fitted_to(self.fitted, inside, begin, settled)

    def _normal_equations(
        self, vector: Vector, residuals: Vector, columns: Vector, inside: Mask
    ) -> tuple[Vector, Vector]:
        """Return gradient (K,) and Hessian (K, K), each kind of residual by its own spread."""
        objective, point = self.fitted.objective, self.fitted.point
        shared = _shared_part(residuals[:, :, inside])[:, None, None]
        error = residuals - shared * residuals.mean(axis=1, keepdims=True)
        slopes = columns - shared[..., None] * columns.mean(axis=1, keepdims=True)
        spread = robust_sd(error[:, :, inside], axis=(1, 2))[:, None, None]
        error = np.where(inside, error, 0.0) / spread
        slopes = np.where(inside[:, None], slopes, 0.0) / spread[..., None]
        robust = huber_weights(error, ROBUST)
        kinds, windows = np.asarray(point.offsets).shape[0], error.shape[-1]
        size = columns.shape[-1] + kinds
        gradient, hessian = np.zeros((size, windows)), np.zeros((size, size, windows))
        gradient[:-kinds] = np.einsum("asfk,asf->kf", slopes, robust * error)
        hessian[:-kinds, :-kinds] = np.einsum("asfk,asf,asfl->klf", slopes, robust, slopes)
        sums = SegmentSums(
            loss=np.asarray(0.5 * (robust * error**2).sum(axis=(0, 1))),
            gradient=np.asarray(gradient),
            hessian=np.asarray(hessian),
            squares={},
            counts={},
            crash_time=np.full(windows, np.inf),
            states=None,
        )
        _, down, curved = normal_equations(
            objective,
            Point(np.asarray(vector), point.offsets),
            self.fitted.criterion,
            sums,
        )
        count = columns.shape[-1]
        return np.asarray(down)[:count], np.asarray(curved)[:count, :count]


def _shared_part(residuals: Vector) -> Vector:
    """Return the part (6,) of a window's mean residual to take off, which leaves white ones.

    Drift of the measured speeds is the same throughout a window: a random intercept, whose variance
    beside that of the rest says how much less the mean tells than what is within (generalised
    least squares; Fuller and Battese 1973).

    Parameters
    ----------
    residuals
        (6, S, F) of S stretches of F windows.
    """
    stretches = residuals.shape[1]
    mean = residuals.mean(axis=1)
    within = robust_sd(residuals - mean[:, None], axis=(1, 2)) ** 2
    within = within * stretches / max(stretches - 1, 1)
    between = np.maximum(robust_sd(mean, axis=(1,)) ** 2, within / stretches)
    return np.asarray(1.0 - np.sqrt(within / stretches / between))


def with_inputs_balanced(
    job: Job,
    fitted: Fitted,
    examination: Examination,
    on_message: Callable[[str], None],
    *,
    in_doubt: Mapping[str, float] = MappingProxyType({}),
) -> tuple[Fitted, Examination, tuple[Finding, ...]]:
    """Return the fit whose inertia balances motion and rotor speeds, or as it is; what to say.

    With it the examination of what is returned, whose intervals reach as far as the balance where
    that is not taken; ``in_doubt`` is as for `examine`.

    Only where rotor speeds are fed in: how commands turn into them would have to be known first.
    """
    objective = fitted.objective
    segments = objective.segments
    model = objective.model_at(fitted.point.coefficients)
    frames = markers_of(model.vehicle), gyro_of(model.vehicle)
    if (
        objective.conditions
        or jax.tree.leaves(frames)
        or job.accelerations is not None
        or any(inlet != "rotor_speed" for inlet in job.inlets)
    ):
        return fitted, examination, ()
    on_message("Balancing the recorded motion and the rotor speeds.")
    balance = balance_of(objective, fitted.point, job.fitted)
    settling = _Settling(fitted, balance)
    begin = np.asarray(fitted.point.coefficients)
    balanced = settling.at(np.ones(segments.count, bool), begin)
    vector = settling.refitted(np.ones(segments.count, bool), balanced)
    as_fitted, as_balanced = _losses_left_out(settling, balanced)
    point = Point(np.asarray(vector), fitted.point.offsets)
    taken = as_balanced <= (1.0 + TOLERATED) * as_fitted
    findings = _findings(fitted, point, as_balanced / as_fitted, taken=taken)
    otherwise = alternatives_of(objective, fitted.point)
    if not taken:
        space = objective.space
        here, there = (space.scaled(v) for v in (begin, balanced))
        moves = dict(zip(space.names, np.abs(there - here).tolist(), strict=True))
        doubt = {n: max(moves[n], in_doubt.get(n, 0.0)) for n in moves if n in TURNS}
        kept = examine(fitted, otherwise=otherwise, in_doubt={**in_doubt, **doubt})
        return fitted, kept, findings
    scores = objective.sums(point, fitted.criterion, derivatives=False)
    loss, _, _ = normal_equations(objective, point, fitted.criterion, scores)
    fitted = replace(fitted, point=point, loss_best=float(loss))
    examination = examine(fitted, otherwise=otherwise, in_doubt=in_doubt, at_minimum=False)
    return fitted, examination, findings


def _losses_left_out(settling: _Settling, balanced: Vector) -> tuple[float, float]:
    """Return the loss of what is left out, over all folds: as fitted to the rest, and balanced."""
    fitted = settling.fitted
    segments, fold = fitted.objective.segments, np.asarray(fitted.objective.segments.flight)
    if fitted.objective.flights < 2:
        fold = (segments.begins > np.median(segments.begins)).astype(int)
    vector = np.asarray(fitted.point.coefficients)
    others = [fold != number for number in np.unique(fold)]
    vectors = np.stack(
        [
            *(_fitted_to(fitted, rest, vector, np.zeros(len(vector), bool)) for rest in others),
            *(settling.refitted(rest, settling.at(rest, balanced)) for rest in others),
        ]
    )
    points = Point(vectors, np.repeat(np.asarray(fitted.point.offsets)[None], len(vectors), axis=0))
    flown = sums_at(fitted.objective, points, fitted.criterion, derivatives=False)
    losses = np.asarray(flown.loss)
    out = [row[~rest].sum() for row, rest in zip(losses, [*others, *others], strict=True)]
    as_fitted, as_balanced = np.reshape(out, (2, -1)).sum(axis=1)
    return float(as_fitted), float(as_balanced)


def _fitted_to(fitted: Fitted, inside: Mask, begin: Vector, settled: Mask) -> Vector:
    """Return where a few steps lead from a vector (K,), if only some windows (F,) are fitted.

    ``settled`` (K,) is what stays as it is there, beside what the fit holds.
    """
    some, criterion = some_segments(fitted.objective, fitted.criterion, inside)
    held = np.isin(fitted.objective.space.names, list(fitted.held.values())) | settled
    problem = StageProblem(
        objective=some,
        criterion=criterion,
        stage=LEFT_OUT,
        points=Point(begin[None], fitted.point.offsets[None]),
        losses=np.array([np.inf]),
        free=Free(~held, np.zeros(fitted.point.offsets.shape, bool)),
        seed=0,
        damping=np.ones(1),
        last=True,
    )
    for iterate in islice(descend(problem), LEFT_OUT.steps):
        if iterate.converged:
            break
    return np.asarray(iterate.points.coefficients[0])


def _findings(fitted: Fitted, balanced: Point, loss: float, *, taken: bool) -> tuple[Finding, ...]:
    """Return which moments of inertia the balance changes by more than `REPORT_ABOVE`, if any.

    ``loss`` is that of what was left out, over the fit's.
    """
    space = fitted.objective.space
    before, after = (space.numbers(p.coefficients) for p in (fitted.point, balanced))
    changed = {
        name: (before[name], after[name])
        for name in before
        if name.startswith("inertia_") and abs(after[name] / before[name] - 1.0) > REPORT_ABOVE
    }
    if not changed:
        return ()
    code = Code.INERTIA_BALANCED if taken else Code.INERTIA_NOT_BALANCED
    numbers = {
        key: value
        for name, (old, new) in changed.items()
        for key, value in ((f"{name}_fitted", old), (f"{name}_balanced", new))
    }
    numbers["error"] = float(np.sqrt(loss))
    level: Level = "info" if taken else "warning"
    return (Finding(code, level, "moments of inertia", numbers, tuple(changed)),)
