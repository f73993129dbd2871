"""What a user should know before believing a number: codes and numbers, no prose.

Sentences and remedies are made from them in `tuner.wording.findings`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal

LARGEST = 1e300
"""What stands for a number that is not finite, which JSON does not have."""

Level = Literal["failure", "warning", "info"]


class Code(StrEnum):
    """What was noticed; the comment after each names its numbers and its names."""

    RECORDING = "recording"  # count and numbers, names: code, topic and names of the `Note`
    SALVAGED = "salvaged"  # those of `tuner.recordings.notes.Damage`; names: its cause and subject
    LEFT_OUT = "left_out"  # names: what the flight lacks, what to do
    FLIGHT_WORSE = "flight_worse"  # before, after; names: position or attitude, its unit
    FLIGHT_CRASHES = "flight_crashes"  # seconds
    PART_FAILED = "part_failed"  # names: the type of the error, its text
    MISSING_SIGNALS = "missing_signals"  # names: the signals
    POSE_GAP = "pose_gap"  # seconds
    WRONG_VEHICLE = "wrong_vehicle"  # lift, weight (N), mass (kg)
    CANNOT_HOVER = "cannot_hover"  # idle, full, weight (N), mass (kg)
    SPARSE_INPUT = "sparse_input"  # recorded, needed (Hz); names: the signal
    INLET_CHOSEN = "inlet_chosen"  # correlation, recorded, gyro (Hz); names: inlet, signal, order?
    MANOEUVRES_CHOSEN = "manoeuvres_chosen"  # fitted, flights; names: recording, numbers
    PX4_LOOPS = "px4_loops"  # names: the inlet
    LOGGED_GAINS = "logged_gains"  # names: what the log has otherwise, each as a clause
    LOGS_DIFFER = "logs_differ"  # names: the parameters
    ATTITUDE_FOLLOWED = "attitude_followed"  # names: the inlet that it could have entered through
    MOTOR_ORDER = "motor_order"  # names: the recorded columns, from 1, in the vehicle's order
    SPINS_REVERSED = "spins_reversed"
    SETPOINTS_SCALED = "setpoints_scaled"  # gain, correlation; names: the axis, the law guessed
    SETPOINTS_LATE = "setpoints_late"  # seconds
    SETPOINTS_BIASED = "setpoints_biased"  # bias (rad/s); names: the axis
    SETPOINTS_FOREIGN = "setpoints_foreign"  # axis -> correlation
    HEADING_FLOWN = "heading_flown"  # correlation
    STILL_AXES = "still_axes"  # names: the axes
    NO_YAW = "no_yaw"  # rate (rad/s)
    IMPLAUSIBLE_BOUNDS = "implausible_bounds"  # lower, upper, plausible_lower, plausible_upper
    START_ON_BOUND = "start_on_bound"  # bound, start
    NOT_FINITE = "not_finite"
    NOTHING_HAS_EFFECT = "nothing_has_effect"
    NO_EFFECT = "no_effect"
    SINGULAR_DIRECTION = "singular_direction"  # names: the coefficients
    SATURATION_FEEDBACK = "saturation_feedback"  # feedback: 1 if the integrator stops, else 0
    SEES_MARKERS = "sees_markers"  # seen: 1 if position and attitude control see them, else 0
    CLOCK_OFFSET = "clock_offset"  # seconds; names: the clock
    TURNING_UNEXPLAINED = "turning_unexplained"  # explained (share)
    TURNING_REGRESSED = "turning_regressed"  # explained_AXIS (shares), gain_AXIS, seconds
    TURNING_NOT_PREDICTED = "turning_not_predicted"  # likewise, no seconds
    HOLDING_BETTER = "holding_better"  # seconds, QUANTITY, QUANTITY_held; names: QUANTITYs
    INERTIA_BALANCED = "inertia_balanced"  # error, NAME_fitted, NAME_balanced; names: NAMEs
    INERTIA_NOT_BALANCED = "inertia_not_balanced"  # likewise
    DISTURBANCES_FOLLOWED = "disturbances_followed"  # gust, thrust (shares), both _seconds
    ROTOR_CHANGED = "rotor_changed"  # seconds, rotor (from 1), loss (share); names: its place
    INPUT_LATE = "input_late"  # seconds
    GYRO_OFFSET = "gyro_offset"  # rate (rad/s); names: the axis
    FLIGHT_UNMATCHED = "flight_unmatched"  # channel -> multiple of the noise
    MODEL_UNMATCHED = "model_unmatched"  # unmatched, flights, noise_multiple
    FINER_THAN_STEPS = "finer_than_steps"  # seconds
    REFERENCE_VOLTAGE = "reference_voltage"  # volts
    POORLY_MET = "poorly_met"  # noise_multiple; names: the channel
    STARTS_DISAGREE = "starts_disagree"  # starts, changed: 1 if CMA-ES ended lower, else 0
    FLIGHTS_FAR_OFF = "flights_far_off"  # far_off, flights, changed
    GROUND_CONFLICT = "ground_conflict"  # deviation (standard errors), ground, flights; names: unit
    SCALES_WITH_MASS = "scales_with_mass"  # mass (kg); names: the coefficients
    NO_TACHOMETER = "no_tachometer"
    YAW_OPEN = "yaw_open"
    RATE_WORSE = "rate_worse"  # before, after, hold (rad/s), seconds
    RATE_FORETOLD = "rate_foretold"  # before, after, hold (rad/s), seconds
    RATE_NOT_FORETOLD = "rate_not_foretold"  # before, after, hold (rad/s), seconds
    VEHICLE_NOT_GIVEN = "vehicle_not_given"
    BENCH_CONFLICT = "bench_conflict"  # deviation (standard errors); names: the coefficients


@dataclass(frozen=True)
class Finding:
    """Something that a user should know before believing a number.

    Attributes
    ----------
    code
        What was noticed.
    level
        ``failure`` stops a run unless forced, ``warning`` does not, ``info`` explains.
    subject
        The flight, coefficient or part concerned.
    numbers, names
        What `Code` lists beside the code.
    """

    code: Code
    level: Level
    subject: str
    numbers: Mapping[str, int | float] = field(default_factory=dict)
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Replace what JSON has no number for."""
        if not all(math.isfinite(number) for number in self.numbers.values()):
            finite = {n: v if math.isfinite(v) else LARGEST for n, v in self.numbers.items()}
            object.__setattr__(self, "numbers", finite)
