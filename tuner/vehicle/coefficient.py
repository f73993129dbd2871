"""The columns of the registry of coefficients."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

Scope = Literal["vehicle", "setup", "flight", "window"]
Scale = Literal["log", "linear"]
Place = tuple[str, str]

EFFECTS = "effects"
"""The vehicle file's flat section of the terms beyond Gazebo's motor model."""

_PYTREE_NODES = {"": "body", "inertia": "body"}


LoopPart = Literal["", "estimate", "rate control", "motors", "tachometer", "turning"]


@dataclass(frozen=True)
class Written:
    """An export target holds the coefficient.

    Attributes
    ----------
    tag
        The name of the tag or parameter in the target's file.
    parent
        The kind of element that the tag stands in, where a target has several.
    """

    tag: str
    parent: str = ""


@dataclass(frozen=True)
class NotCarried:
    """An export target has no place for the coefficient.

    Attributes
    ----------
    reason
        What the user reads when the coefficient is not at the value that the target has built in.
    built_in
        The value with which the target flies; None where the target simulates nothing of the kind,
        so that the coefficient stays with the set-up.
    """

    reason: str
    built_in: float | None = None


@dataclass(frozen=True)
class Coefficient:
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
        What has one value of it: the ``vehicle``, its ``setup``, each ``flight``, or each
        ``window`` of a flight.
    place
        Section and key in the vehicle file, for the scopes ``vehicle`` and ``setup``. The sections
        are those of `tuner.vehicle.vehicle`; a coefficient in ``effects`` needs no other entry.
    part
        The part of the loop in which alone it acts, if any: where recorded signals take its place,
        a simulation says nothing of the coefficient.
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
        The power of a common factor on all masses with which it must go so that every motion stays
        the same: 1 for masses, inertias and what forces are proportional to.
    length_exponent
        The power of a common factor on all lengths, with times as the root of it, with which what
        is usual for it goes; only read where the search moves the number.
    hold_rank
        Of coefficients that trade off against each other, the one of the lowest rank is held: what
        is weighed or set rather than flown. None comes after all ranks.
    neutral
        The value at which its term vanishes.
    group
        Of an effect: what a selection of terms adds together; empty for one that follows from the
        others of its kind and is never chosen by itself.
    stands_in
        Of an effect: whether it describes as a whole what other terms do one by one.
    expected
        Of an effect: whether every vehicle has it, if often in a size that flights do not tell.
    begin
        Where a search begins that adds it: for one that at its neutral value does what another
        does. From there to the neutral value reaches the secant by which it is judged.
    acts_as
        That other, which begins lower by as much.
    reads
        Of an effect: the recorded signal that its law reads beside the simulated state, if any.
    exported_as
        Export target -> where the coefficient stands in it, or why it does not.
    informed_by
        The rule of `tuner.recordings.inspector` that decides whether a recording can show it.
    plausible
        Values outside this range are reported as improbable.
    fallback
        Section and key of the controller file that hold where the vehicle file gives no value.
    leaf
        Where it lives in a `tuner.vehicle.model.Model`, if not where `leaf_path` derives it.
    count
        How many numbers it stands for, for the scope ``window``.
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
    group: str = ""
    stands_in: bool = False
    expected: bool = False
    begin: float | None = None
    acts_as: str = ""
    reads: str = ""
    exported_as: Mapping[str, Written | NotCarried] = field(default_factory=dict)
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
        """Whether it belongs to a term that a vehicle file may leave out."""
        return self.place[0] == EFFECTS

    @property
    def is_optional(self) -> bool:
        """Whether nobody misses it at its neutral value: it is neither there nor fitted then."""
        return self.neutral is not None and not self.free

    def limits(self, initial: float) -> tuple[float, float]:
        """Return the default bounds around an initial value, in the coefficient's unit."""
        if isinstance(self.bounds, tuple):
            return self.bounds
        return initial / self.bounds, initial * self.bounds


@dataclass(frozen=True)
class Parameter:
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
        Whether the user gave the prior, or it is the weak default that only steadies the search.
    unit_step
        The change of the scaled coordinate that is one in the search's coordinate, mid-range.
    usual
        Of a linear coefficient, how large it usually is for such a vehicle; zero for others.
    moved
        Set where the start lay on or outside a bound and was moved: the value that it had.
    """

    name: str
    ratios: Mapping[str, float]
    initial: float
    lower: float
    upper: float
    scale: Literal["log", "linear"]
    prior_mean: float
    prior_sd: float
    prior_given: bool
    unit_step: float
    usual: float = 0.0
    moved: float | None = None

    def scaled(self, value: float) -> float:
        """Return the scaled coordinate of a value."""
        return math.log(value) if self.scale == "log" else value
