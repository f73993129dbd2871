"""The registry's rows of what surrounds a vehicle: its set-up, each flight, each window of one."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from tuner.vehicle.coefficient import EFFECTS, Coefficient, LoopPart, NoExportTag

_OF_SETUP = NoExportTag("it belongs to the set-up, not to the vehicle")
_OUTSIDE = {"sdf": _OF_SETUP, "px4": _OF_SETUP}
_AXES = {"x": "forward", "y": "left", "z": "up"}
_CLOCKS = "clocks of the recording"
_SMOOTHED = "smoothing error of the motion capture"


_setup = partial(Coefficient, scope="setup", exported_as=_OUTSIDE)
#: What is zero unless each flight, or each window, says otherwise.
_flight = partial(Coefficient, scope="flight", scale="linear", neutral=0.0)
_window = partial(Coefficient, scope="window", scale="linear", neutral=0.0, count=3)


def _frame(name: str, unit: str, meaning: str, source: str, prior_sd: float) -> Coefficient:
    """Return the row of one axis of where something sits on the vehicle, off by what is usual."""
    more = _setup(name, unit, meaning, source, place=(EFFECTS, name), scale="linear", neutral=0.0)
    return replace(more, bounds=(-0.3, 0.3), prior_sd=prior_sd, step=0.01, group=name[:-2])


_marker = partial(
    _frame, source="the rigid body as defined in the motion capture's software", prior_sd=0.03
)


def _factor(
    name: str,
    meaning: str,
    source: str,
    *,
    group: str,
    bounds: float,
    prior_sd: float,
    part: LoopPart = "",
    is_lag: bool = False,
) -> Coefficient:
    """Return the row of a factor of the set-up that is one where all is as it is said to be."""
    more = _setup(name, "", meaning, source, place=(EFFECTS, name), bounds=bounds, neutral=1.0)
    step = 0.5 * prior_sd
    return replace(more, prior_sd=prior_sd, step=step, group=group, part=part, is_lag=is_lag)


SURROUNDING_ROWS = (
    # what the set-up adds
    _setup(
        "estimate_latency",
        "s",
        "age of the state that the controllers see",
        "motion capture, network and estimator of the laboratory",
        place=("setup", "estimate_latency"),
        part="estimate",
        scale="linear",
        bounds=(0.0, 0.1),
        prior_sd=0.02,
        step=0.01,
        free=True,
        neutral=0.0,
        informed_by="closed loop",
    ),
    _setup(
        "actuator_latency",
        "s",
        "from a motor command to its effect",
        "output driver and speed controller",
        place=("setup", "actuator_latency"),
        part="motors",
        scale="linear",
        bounds=(0.0, 0.04),
        prior_sd=0.005,
        step=0.01,
        free=True,
        hold_rank=3,
        neutral=0.0,
        informed_by="commands and rotor speed",
    ),
    _setup(
        "gyro_cutoff",
        "Hz",
        "low-pass filter of the gyro",
        "PX4 IMU_GYRO_CUTOFF",
        place=("setup", "gyro_cutoff"),
        part="rate control",
        bounds=4.0,
        prior_sd=0.5,
        fallback=("filters", "gyro_cutoff"),
        leaf=("controller", "filters", "gyro_cutoff"),
    ),
    *(
        _marker(
            f"marker_offset_{axis}",
            "m",
            f"point that motion capture records, {direction} of the centre of mass",
        )
        for axis, direction in (("x", "ahead"), ("y", "left"), ("z", "above"))
    ),
    *(
        _marker(
            f"marker_tilt_{axis}",
            "rad",
            f"rotation vector from the body to the motion capture's axes, {direction}",
        )
        for axis, direction in _AXES.items()
    ),
    *(
        _frame(
            f"autopilot_tilt_{axis}",
            "rad",
            f"rotation vector from the body's axes to the autopilot's, {direction}",
            "how the autopilot is mounted; PX4 SENS_BOARD_X_OFF, SENS_BOARD_Y_OFF",
            0.02,
        )
        for axis, direction in (("x", "forward"), ("y", "left"))
    ),
    *(
        _factor(
            f"gyro_scale_{axis}",
            f"what the gyro reads over the body rate about {direction}",
            "sensitivity of MEMS gyros, by their data sheets off by a percent or two",
            group="gyro_scale",
            bounds=1.2,
            prior_sd=0.01,
        )
        for axis, direction in _AXES.items()
    ),
    *(
        _factor(
            f"rate_gain_{axes}",
            f"P, I and D of the rate controller about {words} over those of its file",
            f"PX4 {parameter}; parameters that are not those of the flight",
            group="rate_gain",
            part="rate control",
            bounds=2.0,
            prior_sd=0.1,
        )
        for axes, words, parameter in (
            ("roll_pitch", "roll and pitch", "MC_ROLLRATE_K, MC_PITCHRATE_K"),
            ("yaw", "yaw", "MC_YAWRATE_K"),
        )
    ),
    _factor(
        "integral_gain",
        "I of the rate controller over that of its file",
        "PX4 MC_ROLLRATE_I, MC_PITCHRATE_I, MC_YAWRATE_I; parameters changed since",
        group="integral_gain",
        part="rate control",
        bounds=3.0,
        prior_sd=0.3,
    ),
    _factor(
        "gyro_cutoff_factor",
        "cut-off of the gyro's low-pass filter over that of the controller file",
        "PX4 IMU_GYRO_CUTOFF; parameters changed since",
        group="gyro_filter",
        part="rate control",
        is_lag=True,
        bounds=3.0,
        prior_sd=0.3,
    ),
    _factor(
        "derivative_cutoff_factor",
        "cut-off of the low-pass filter of the rate's derivative over that of the controller file",
        "PX4 IMU_DGYRO_CUTOFF; parameters changed since",
        group="derivative_filter",
        part="rate control",
        is_lag=True,
        bounds=3.0,
        prior_sd=0.3,
    ),
    _factor(
        "attitude_gain",
        "gain of the attitude controller over that of its file",
        "PX4 MC_ROLL_P, MC_PITCH_P; parameters changed since",
        group="attitude_gain",
        part="estimate",
        bounds=2.0,
        prior_sd=0.1,
    ),
    Coefficient(
        name="tachometer_lag",
        unit="s",
        meaning="lag of the recorded rotor speeds behind the rotors' own",
        source="low-pass filters of speed controllers, bridges and loggers",
        scope="setup",
        place=(EFFECTS, "tachometer_lag"),
        scale="linear",
        bounds=(-0.1, 0.1),
        # of filters at 8 to 20 Hz; a tenth of it stamps hide, which tell the period of a loop alone
        prior_sd=0.02,
        step=0.002,
        neutral=0.0,
        group="tachometer_lag",
        part="tachometer",
        is_lag=True,
        exported_as=_OUTSIDE,
    ),
    _factor(
        "tachometer_memory",
        "time constant of the filter of the recorded rotor speeds over its lag",
        "1 of a low-pass, more of one that is computed sample by sample, 1/2 of a dead time",
        group="tachometer_lag",
        part="tachometer",
        bounds=8.0,
        prior_sd=0.5,
    ),
    # what a recording may get wrong by a constant
    _flight(
        "pose",
        "s",
        "lateness of the clock that stamps the motion capture's poses",
        _CLOCKS,
        prior_sd=0.02,
    ),
    _flight(
        "flight_controller",
        "s",
        "lateness of the clock that stamps what the flight controller publishes",
        _CLOCKS,
        prior_sd=0.02,
    ),
    *(
        _flight(
            f"gyro_{axis}",
            "rad/s",
            f"bias of the recorded body rate about {direction}",
            "gyro bias",
            prior_sd=0.02,
        )
        for axis, direction in _AXES.items()
    ),
    # what surrounds a flight
    *(
        _flight(
            f"wind_{axis}",
            "m/s",
            f"steady velocity of the air towards world {axis} during a flight",
            "air conditioning of the hall; the vehicle's own wash",
            prior_sd=0.5,
            group="wind",
        )
        for axis in "xy"
    ),
    _flight(
        "battery_decline",
        "1/s",
        "share of the rotor speeds that is lost each second of a flight",
        "thesis 10.4, where no voltage was recorded: Ω·(1 - λt)",
        prior_sd=0.004,
        group="battery_decline",
        exported_as={
            "sdf": NoExportTag("the motor plugins know no battery", 0.0),
            "px4": NoExportTag("the SIH model's thrust does not depend on the battery", 0.0),
        },
    ),
    *(
        _flight(
            f"accelerometer_{axis}",
            "m/s²",
            f"bias of the recorded specific force along {direction}",
            "accelerometer bias, and the tilt of the sensor in the body",
            prior_sd=0.5,
            group="accelerometer",
        )
        for axis, direction in _AXES.items()
    ),
    # by how much the start of a window differs from the recorded state
    _window(
        "position",
        "m",
        "position at the start of a window, from the smoothed recording's",
        _SMOOTHED,
        prior_sd=0.01,
    ),
    _window(
        "velocity",
        "m/s",
        "velocity at the start of a window, from the smoothed recording's",
        _SMOOTHED,
        prior_sd=0.1,
    ),
    _window(
        "attitude",
        "rad",
        "attitude at the start of a window about the body's axes, from the recording's",
        _SMOOTHED,
        prior_sd=0.03,
    ),
    _window(
        "body_rate",
        "rad/s",
        "body rate at the start of a window, from the smoothed recording's",
        "smoothing error of the gyro",
        prior_sd=0.3,
    ),
    _window(
        "rotor_speed",
        "",
        "share by which a rotor turns faster at the start of a window than recorded",
        "smoothing error of the tachometer, or of the command's lag",
        prior_sd=0.05,
        count=4,
    ),
    _window(
        "rate_integral",
        "",
        "output of the rate controller's integrator at the start of a window",
        "no recording holds it",
        prior_sd=0.05,
    ),
    _window(
        "trim",
        "",
        "steady difference between commanded and acting torque during a window",
        "uneven rotors and an offset mass; the integrator takes it in closed loop",
        prior_sd=0.02,
    ),
)
