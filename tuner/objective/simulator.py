"""A simulation of some segments, compared with their recordings and differentiated forwards.

Flying is a kernel's (`tuner.objective.flown`); reading a simulation at the recorded stamps and
summing up is linear, and NumPy's. Segments come first in every array here, columns of derivatives
last.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import jax
import numpy as np
from numpy.typing import NDArray

from sim_jax.crash import Limits
from sim_jax.schedule import Schedule
from tuner.objective.criterion import (
    OFFSET_UNIT,
    Jacobian,
    SegmentData,
    SegmentSums,
    units_of,
)
from tuner.objective.flown import Flown, fly
from tuner.objective.initial_conditions import eliminated
from tuner.objective.residuals import Reading, gauss_newton, residuals, robust
from tuner.objective.segments import OFFSETS
from tuner.objective.tunable import Tunable

Array = NDArray[np.float64]

MEMORY = 2**30
"""bytes that derivatives take at most by default while they are computed."""


@dataclass(frozen=True)
class Simulator:
    """The static half of an objective."""

    schedule: Schedule
    samples: int
    """Of a log, at most."""
    limits: Limits
    memory: int = MEMORY
    conditions: tuple[str, ...] = ()
    """Per-flight conditions that enter a simulation, behind the offsets."""

    def fly(
        self,
        data: SegmentData,
        model: Tunable,
        coefficients: Array,
        horizon: int,
        *,
        moving: Sequence[str] = (),
    ) -> Flown:
        """Fly segments with a search vector (K,) up to a horizon in samples.

        Parameters
        ----------
        data, model, coefficients, horizon
            What is flown.
        moving
            By what is differentiated, in this order of columns: ``coefficients``, ``conditions``,
            ``states``.
        """
        offsets = np.asarray(data.offsets)
        units = units_of(self.conditions)
        rows = offsets[len(OFFSETS) :]
        conditions = {name: rows[row] * units[row] for row, name in enumerate(self.conditions)}
        return fly(
            model.model,
            data.segments,
            self.schedule,
            samples=min(horizon, self.samples),
            limits=self.limits,
            coefficients=model.values(coefficients),
            states=None if data.states is None else np.asarray(data.states),
            conditions=conditions,
            tangents=self._directions(data, model, coefficients, moving) or None,
        )

    def _directions(
        self, data: SegmentData, model: Tunable, coefficients: Array, moving: Sequence[str]
    ) -> dict[str, Array]:
        """Return the directions of all columns: of coefficients, conditions and starts."""
        blocks = {
            "coefficients": len(coefficients),
            "conditions": len(self.conditions),
            "states": 0 if data.states is None else len(data.states),
        }
        total, first, directions = sum(blocks[name] for name in moving), 0, {}
        for name in moving:
            rows = slice(first, first + blocks[name])
            first += blocks[name]
            if name == "coefficients":
                for coefficient, slope in model.slopes(coefficients).items():
                    directions[coefficient] = np.zeros(total)
                    directions[coefficient][rows] = slope
            elif name == "conditions":
                for row, (condition, unit) in enumerate(
                    zip(self.conditions, units_of(self.conditions), strict=True)
                ):
                    directions[condition] = np.zeros(total)
                    directions[condition][rows.start + row] = unit
            elif blocks[name]:
                directions["states"] = np.zeros((total, blocks[name]))
                directions["states"][rows] = np.eye(blocks[name])
        return directions

    def reading(
        self, data: SegmentData, horizon: int, columns: int = 0, coefficients: int | None = None
    ) -> Reading:
        """Return how a simulation is read to be compared; the arguments are those of `Reading`."""
        return Reading(
            np.asarray(data.offsets)[: len(OFFSETS)] * OFFSET_UNIT,
            np.asarray(data.reference_offset),
            float(self.schedule.log_rate),
            horizon,
            columns,
            coefficients,
            OFFSET_UNIT,
        )

    def sums(
        self,
        data: SegmentData,
        model: Tunable,
        coefficients: Array,
        horizon: int,
        huber: float,
        *,
        derivatives: bool,
        still: bool = False,
    ) -> SegmentSums:
        """Return what some segments contribute; see `Objective.sums`."""
        moving = self._moving(data, derivatives=derivatives)
        moving = moving[1:] if still and derivatives else moving
        parts = [
            self._sums_of(part, model, coefficients, (horizon, huber), moving)
            for part in self._in_turn(data, horizon, self._columns(data, coefficients, moving))
        ]
        return _joined(parts)

    def _moving(self, data: SegmentData, *, derivatives: bool) -> tuple[str, ...]:
        states = () if data.states is None else ("states",)
        return ("coefficients", "conditions", *states) if derivatives else states

    def _columns(self, data: SegmentData, coefficients: Array, moving: Sequence[str]) -> int:
        """Return how many columns a simulation's derivatives have."""
        sizes = {
            "coefficients": len(coefficients),
            "conditions": len(self.conditions),
            "states": 0 if data.states is None else len(data.states),
        }
        return sum(sizes[name] for name in moving)

    def _in_turn(self, data: SegmentData, horizon: int, columns: int) -> list[SegmentData]:
        """Return the segments in parts whose derivatives fit the memory."""
        measured = data.segments.measured.values()
        logged = min(horizon, self.samples) * sum(np.shape(m.values)[1] for m in measured)
        segments = np.shape(data.offsets)[-1]
        size = max(int(self.memory // max(8 * (columns + 1) * logged, 1)), 1)
        if size >= segments:
            return [data]
        return [
            jax.tree.map(partial(_some, first=first, size=size), data)
            for first in range(0, segments, size)
        ]

    def _sums_of(
        self,
        data: SegmentData,
        model: Tunable,
        coefficients: Array,
        criterion: tuple[int, float],
        moving: Sequence[str],
    ) -> SegmentSums:
        horizon, huber = criterion
        flown = self.fly(data, model, coefficients, horizon, moving=moving)
        derivatives, segments = "conditions" in moving, len(flown.crash_time)
        first = len(coefficients) if "coefficients" in moving else 0
        size = first + len(np.asarray(data.offsets))
        reading = self.reading(
            data,
            horizon,
            self._columns(data, coefficients, moving),
            first if derivatives else None,
        )
        total = reading.total
        gradient, hessian = np.zeros((segments, total)), np.zeros((segments, total, total))
        loss, squares, counts, by_start = np.zeros(segments), {}, {}, {}
        starts = 0 if data.states is None else len(data.states)
        for name in data.segments.measured:
            scale = np.asarray(data.scale[name])
            square, count = np.zeros(segments), np.zeros(segments)
            slope, bend = np.zeros((segments, starts)), np.zeros((segments, starts, starts))
            for block in residuals(flown, data.segments, name, reading):
                some = block.segments
                square[some] += np.einsum("fnk,fnk->f", block.errors, block.errors)
                count[some] += block.counts.sum(axis=(1, 2))
                scaled = block.errors / scale[some, None, None]
                loss[some] += 0.5 * robust(scaled, huber).sum(axis=(1, 2))
                if total:
                    along, across = gauss_newton(block.columns, scaled, scale[some], huber)
                    gradient[some] += along
                    hessian[some] += across
                if starts:
                    own = block.columns[..., -starts:]
                    slope[some] += np.einsum("fnk,fnkl->fl", block.errors, own)
                    bend[some] += np.einsum("fnkl,fnkm->flm", own, own)
            squares[name], counts[name], by_start[name] = square, count, (slope, bend)
        best = None
        if data.states is not None:
            states = np.asarray(data.states)
            loss, gradient, hessian, best = eliminated(loss, gradient, hessian, states)
            change = (best - states).T
            for name, (slope, bend) in by_start.items():
                squares[name] = squares[name] + np.einsum(
                    "fl,fl->f", change, 2.0 * slope + np.einsum("flm,fm->fl", bend, change)
                )
        if not derivatives:
            size += len(coefficients)
            gradient, hessian = np.zeros((segments, size)), np.zeros((segments, size, size))
        return SegmentSums(
            loss,
            np.moveaxis(gradient, 0, -1),
            np.moveaxis(hessian, 0, -1),
            squares,
            counts,
            flown.crash_time,
            best,
        )

    def jacobian(
        self, data: SegmentData, model: Tunable, coefficients: Array, horizon: int
    ) -> Jacobian:
        """Return every residual of some segments and its derivatives."""
        moving = self._moving(data, derivatives=True)
        flown = self.fly(data, model, coefficients, horizon, moving=moving)
        reading = self.reading(
            data, horizon, self._columns(data, coefficients, moving), len(coefficients)
        )
        errors, columns = self._laid_out(data, flown, reading)
        return Jacobian(errors, columns, flown.crash_time)

    def errors(
        self, data: SegmentData, model: Tunable, coefficients: Array, horizon: int
    ) -> tuple[Flown, dict[str, Array]]:
        """Return a simulation, and channel -> (n, k, F) residuals, without derivatives."""
        flown = self.fly(data, model, coefficients, horizon)
        return flown, self._laid_out(data, flown, self.reading(data, horizon))[0]

    def _laid_out(
        self, data: SegmentData, flown: Flown, reading: Reading
    ) -> tuple[dict[str, Array], dict[str, Array]]:
        """Return channel -> (n, k, F) residuals, and channel -> (Q, n, k, F) columns."""
        errors, columns = {}, {}
        for name, measured in data.segments.measured.items():
            n, k, segments = np.shape(measured.weight)
            error, column = np.zeros((segments, n, k)), np.zeros((segments, n, k, reading.total))
            for block in residuals(flown, data.segments, name, reading):
                place = np.arange(segments)[block.segments, None], block.stamps
                error[place], column[place] = block.errors, block.columns
            errors[name] = np.moveaxis(error, 0, -1)
            columns[name] = np.moveaxis(column, (-1, 0), (0, -1))
        return errors, columns


def _some(leaf: Array, first: int, size: int) -> Array:
    return np.asarray(leaf)[..., first : first + size]


def _joined(parts: Sequence[SegmentSums]) -> SegmentSums:
    if len(parts) == 1:
        return parts[0]
    joined: SegmentSums = jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=-1), *parts)
    return joined
