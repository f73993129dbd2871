"""The registry's rows of what surrounds a vehicle: its set-up, each flight, each window of one."""

from __future__ import annotations

from functools import partial

from tuner.vehicle.coefficient import EFFECTS, Coefficient, NotCarried, Scope

_OF_SETUP = NotCarried("it belongs to the set-up, not to the vehicle")
_OUTSIDE = {"sdf": _OF_SETUP, "px4": _OF_SETUP}
_AXES = {"x": "forward", "y": "left", "z": "up"}
_CLOCKS = "clocks of the recording"
_SMOOTHED = "smoothing error of the motion capture"


def _frame(name: str, unit: str, meaning: str, source: str, *, prior_sd: float) -> Coefficient:
    """Return the row of one axis of where something sits on the vehicle, off by what is usual."""
    return Coefficient(
        name=name,
        unit=unit,
        meaning=meaning,
        source=source,
        scope="setup",
        place=(EFFECTS, name),
        scale="linear",
        bounds=(-0.3, 0.3),
        prior_sd=prior_sd,
        step=0.01,
        neutral=0.0,
        group=name[:-2],
        exported_as=_OUTSIDE,
    )


_marker = partial(
    _frame, source="the rigid body as defined in the motion capture's software", prior_sd=0.03
)


def _factor(
    name: str, meaning: str, source: str, *, group: str, bounds: float, prior_sd: float
) -> Coefficient:
    """Return the row of a factor of the set-up that is one where all is as it is said to be."""
    return Coefficient(
        name=name,
        unit="",
        meaning=meaning,
        source=source,
        scope="setup",
        place=(EFFECTS, name),
        bounds=bounds,
        prior_sd=prior_sd,
        step=0.5 * prior_sd,
        neutral=1.0,
        group=group,
        exported_as=_OUTSIDE,
    )


def _around(
    name: str,
    unit: str,
    prior_sd: float,
    meaning: str,
    source: str,
    *,
    scope: Scope,
    group: str = "",
    count: int = 1,
) -> Coefficient:
    """Return the row of what is zero unless each flight, or each window, says otherwise."""
    return Coefficient(
        name=name,
        unit=unit,
        meaning=meaning,
        source=source,
        scope=scope,
        scale="linear",
        prior_sd=prior_sd,
        neutral=0.0,
        group=group,
        count=count,
    )


_of_flight = partial(_around, scope="flight")
_of_window = partial(_around, scope="window", count=3)

SURROUNDING_ROWS = (
    # what the set-up adds
    Coefficient(
        name="estimate_latency",
        unit="s",
        meaning="age of the state that the controllers see",
        source="motion capture, network and estimator of the laboratory",
        scope="setup",
        place=("setup", "estimate_latency"),
        scale="linear",
        bounds=(0.0, 0.1),
        prior_sd=0.02,
        step=0.01,
        free=True,
        neutral=0.0,
        exported_as=_OUTSIDE,
        informed_by="closed loop",
    ),
    Coefficient(
        name="actuator_latency",
        unit="s",
        meaning="from a motor command to its effect",
        source="output driver and speed controller",
        scope="setup",
        place=("setup", "actuator_latency"),
        scale="linear",
        bounds=(0.0, 0.04),
        prior_sd=0.005,
        step=0.01,
        free=True,
        hold_rank=3,
        neutral=0.0,
        exported_as=_OUTSIDE,
        informed_by="commands and rotor speed",
    ),
    Coefficient(
        name="gyro_cutoff",
        unit="Hz",
        meaning="low-pass filter of the gyro",
        source="PX4 IMU_GYRO_CUTOFF",
        scope="setup",
        place=("setup", "gyro_cutoff"),
        bounds=4.0,
        prior_sd=0.5,
        fallback=("filters", "gyro_cutoff"),
        leaf=("controller", "filters", "gyro_cutoff"),
        exported_as=_OUTSIDE,
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
            prior_sd=0.02,
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
            bounds=2.0,
            prior_sd=0.1,
        )
        for axes, words, parameter in (
            ("roll_pitch", "roll and pitch", "MC_ROLLRATE_K, MC_PITCHRATE_K"),
            ("yaw", "yaw", "MC_YAWRATE_K"),
        )
    ),
    # what a recording may get wrong by a constant
    _of_flight(
        "pose", "s", 0.02, "lateness of the clock that stamps the motion capture's poses", _CLOCKS
    ),
    _of_flight(
        "flight_controller",
        "s",
        0.02,
        "lateness of the clock that stamps what the flight controller publishes",
        _CLOCKS,
    ),
    *(
        _of_flight(
            f"gyro_{axis}",
            "rad/s",
            0.02,
            f"bias of the recorded body rate about {direction}",
            "gyro bias",
        )
        for axis, direction in _AXES.items()
    ),
    # what surrounds a flight
    *(
        _of_flight(
            f"wind_{axis}",
            "m/s",
            0.5,
            f"steady velocity of the air towards world {axis} during a flight",
            "air conditioning of the hall; the vehicle's own wash",
            group="wind",
        )
        for axis in "xy"
    ),
    Coefficient(
        name="battery_decline",
        unit="1/s",
        meaning="share of the rotor speeds that is lost each second of a flight",
        source="thesis 10.4, where no voltage was recorded: Ω·(1 - λt)",
        scope="flight",
        scale="linear",
        prior_sd=0.004,
        neutral=0.0,
        group="battery_decline",
        exported_as={
            "sdf": NotCarried("the motor plugins know no battery", 0.0),
            "px4": NotCarried("the SIH model's thrust does not depend on the battery", 0.0),
        },
    ),
    *(
        _of_flight(
            f"accelerometer_{axis}",
            "m/s²",
            0.5,
            f"bias of the recorded specific force along {direction}",
            "accelerometer bias, and the tilt of the sensor in the body",
            group="accelerometer",
        )
        for axis, direction in _AXES.items()
    ),
    # by how much the start of a window differs from the recorded state
    _of_window(
        "position",
        "m",
        0.01,
        "position at the start of a window, from the smoothed recording's",
        _SMOOTHED,
    ),
    _of_window(
        "velocity",
        "m/s",
        0.1,
        "velocity at the start of a window, from the smoothed recording's",
        _SMOOTHED,
    ),
    _of_window(
        "attitude",
        "rad",
        0.03,
        "attitude at the start of a window about the body's axes, from the recording's",
        _SMOOTHED,
    ),
    _of_window(
        "body_rate",
        "rad/s",
        0.3,
        "body rate at the start of a window, from the smoothed recording's",
        "smoothing error of the gyro",
    ),
    _of_window(
        "rotor_speed",
        "",
        0.05,
        "share by which a rotor turns faster at the start of a window than recorded",
        "smoothing error of the tachometer, or of the command's lag",
        count=4,
    ),
    _of_window(
        "rate_integral",
        "",
        0.05,
        "output of the rate controller's integrator at the start of a window",
        "no recording holds it",
    ),
    _of_window(
        "trim",
        "",
        0.02,
        "steady difference between commanded and acting torque during a window",
        "uneven rotors and an offset mass; the integrator takes it in closed loop",
    ),
)
