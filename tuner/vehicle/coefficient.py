"""The columns of the registry of coefficients."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

Scope = Literal["vehicle", "setup", "flight", "window"]
Scale = Literal["log", "linear"]
Place = tuple[str, str]

EFFECTS = "effects"
"""The vehicle file's flat section of the terms beyond Gazebo's motor model."""

_PYTREE_NODES = {"": "body", "inertia": "body"}


LoopPart = Literal["", "estimate", "rate control", "motors", "tachometer", "turning"]


@dataclass(frozen=True)
class ExportTag:
    """The place of a coefficient in an export target's file.

    Attributes
    ----------
    tag
        The name of the tag or parameter in the target's file.
    parent
        The kind of parent element, if a target has several.
    """

    tag: str
    parent: str = ""


@dataclass(frozen=True)
class NoExportTag:
    """An export target has no place for the coefficient.

    Attributes
    ----------
    reason
        The message for a coefficient that is not at the target's built-in value.
    built_in
        The value in the target's simulation; None for coefficients of the set-up.
    """

    reason: str
    built_in: float | None = None


class ScaledQuantity:
    """A quantity with a scaled coordinate: the logarithm of its value, or the value itself."""

    scale: Scale

    def scaled(self, value: float) -> float:
        """Return the scaled coordinate of a value."""
        return math.log(value) if self.scale == "log" else value

    def value_at(self, scaled: float) -> float:
        """Return the value at a scaled coordinate."""
        return float(np.exp(scaled) if self.scale == "log" else scaled)

    def error_at(self, scaled: float, deviation: float) -> float:
        """Return the standard error of a value from that of its scaled coordinate."""
        return float(deviation * (self.value_at(scaled) if self.scale == "log" else 1.0))


@dataclass(frozen=True)
class Coefficient(ScaledQuantity):
    """A number that a fit can move: one row of the registry.

    Attributes
    ----------
    name
        As users write it.
    unit
        Of its value; empty for a ratio.
    meaning
        What it is, in a line for people.
    source
        The equation, table, paper or file that defines it.
    scope
        Whether it has one value for the ``vehicle``, its ``setup``, each ``flight``, or each
        ``window`` of a flight.
    place
        Section and key in the vehicle file, for the scopes ``vehicle`` and ``setup``. The sections
        are those of `tuner.vehicle.vehicle`; a coefficient in ``effects`` needs no other entry.
    part
        The part of the loop in which it acts: with a recorded signal as input below that part, the
        coefficient has no effect.
    scale
        Whether the search moves the logarithm or the number.
    bounds
        For ``log`` a factor either side of the initial value, for ``linear`` absolute limits.
    prior_sd
        Standard deviation of the weak default prior around the initial value: of the logarithm for
        ``log``, else in the coefficient's unit.
    step
        The change of the scaled coordinate that is one in the search's coordinate, mid-range.
    free
        Whether it is fitted unless the job fixes it.
    mass_exponent
        The power of a common factor on all masses that leaves every motion the same: 1 for masses,
        inertias and constants of forces.
    length_exponent
        The power of a common factor on all lengths (times scale as its root) with which its usual
        size scales; only for ``linear``.
    hold_rank
        Of coefficients that are confounded, the one of the lowest rank is held: weighed or set ones
        before those that flights show. None comes last.
    neutral
        The value at which its term vanishes.
    by_law
        Of a coefficient of Gazebo's law that other vehicles may not follow: its value there.
    group
        The group that a selection of terms adds together; empty for an effect that follows from
        others, and for most coefficients of the base model.
    is_aggregate
        Of an effect: whether it is the sum of other terms' effects.
    expected
        Of an effect: whether every vehicle has it, though flights may not show it.
    is_lag
        Of an effect: whether it delays. In gusts a fit without it makes up for it with other lags
        and disturbances, so that only a fit with it shows what it explains.
    begin
        The start of a search that adds it, if it equals another coefficient at its neutral value.
        It is judged by the secant from there to the neutral value.
    equivalent_to
        That other coefficient, which starts lower by as much.
    reads
        Of an effect: the recorded signal that its law needs, if any.
    exported_as
        Export target -> its place there, or why it has none.
    informed_by
        The rule of `tuner.recordings.inspection_rules` on whether a recording can show it.
    plausible
        Values outside this range are reported as improbable.
    fallback
        Section and key of the controller file for the default value.
    leaf
        Its path in a `tuner.vehicle.model.Model`, if `leaf_path` cannot derive it.
    count
        Its count of numbers, for the scope ``window``.
    """

    name: str
    unit: str
    meaning: str
    source: str
    scope: Scope = "vehicle"
    place: Place = ("", "")
    part: LoopPart = ""
    scale: Scale = "log"
    bounds: float | tuple[float, float] = (float("-inf"), float("inf"))
    prior_sd: float = 1.0
    step: float = 1.0
    free: bool = False
    mass_exponent: int = 0
    length_exponent: float = 0.0
    hold_rank: int | None = None
    neutral: float | None = None
    by_law: float | None = None
    group: str = ""
    is_aggregate: bool = False
    expected: bool = False
    is_lag: bool = False
    begin: float | None = None
    equivalent_to: str = ""
    reads: str = ""
    exported_as: Mapping[str, ExportTag | NoExportTag] = field(default_factory=dict)
    informed_by: str | None = None
    plausible: tuple[float, float] | None = None
    fallback: Place | None = None
    leaf: tuple[str, ...] | None = None
    count: int = 1

    @property
    def leaf_path(self) -> tuple[str, ...]:
        """The attributes that lead from a `tuner.vehicle.model.Model` to its number."""
        section = self.place[0]
        return self.leaf or ("vehicle", _PYTREE_NODES.get(section, section), self.name)

    @property
    def is_effect(self) -> bool:
        """Whether it belongs to an optional term."""
        return self.place[0] == EFFECTS

    @property
    def unselected(self) -> float | None:
        """Its value where a selection of terms leaves its group out."""
        return self.neutral if self.by_law is None else self.by_law

    @property
    def is_optional(self) -> bool:
        """Whether it may be absent: it is not fitted by default and has a neutral value."""
        return self.neutral is not None and not self.free

    def limits(self, initial: float) -> tuple[float, float]:
        """Return the default bounds around an initial value, in the coefficient's unit."""
        if isinstance(self.bounds, tuple):
            return self.bounds
        return initial / self.bounds, initial * self.bounds


@dataclass(frozen=True)
class Parameter(ScaledQuantity):
    """One coordinate of the search: a coefficient, or several that are tied to it.

    Attributes
    ----------
    name
        The coefficient; for a tie, the first of the group.
    ratios
        Coefficient -> multiple of this parameter's value (1 for itself).
    initial, lower, upper
        In the coefficient's unit; the initial value is strictly inside.
    scale
        ``log`` or ``linear``.
    prior_mean, prior_sd
        In the scaled coordinate (logarithm or number).
    prior_given
        Whether the user gave the prior, rather than the weak default.
    unit_step
        The change of the scaled coordinate that is one in the search's coordinate, mid-range.
    usual
        Of a linear coefficient, its usual size for such a vehicle; zero for others.
    moved
        The original start, if it lay on or outside a bound and was moved.
    """

    name: str
    ratios: Mapping[str, float]
    initial: float
    lower: float
    upper: float
    scale: Scale
    prior_mean: float
    prior_sd: float
    prior_given: bool
    unit_step: float
    usual: float = 0.0
    moved: float | None = None
