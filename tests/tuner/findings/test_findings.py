"""Every finding has a sentence, and a sentence is whole."""

import pytest

from tuner.findings.findings import (
    Code,
    Finding,
    merge_alike,
    one_line,
    remedy,
    sentence,
    shorten_finding,
)
from tuner.findings.sentences import PREDICTED_UNITS

#: What each code's maker gives beside it.
MADE = {
    Code.RECORDING: Finding(
        Code.RECORDING, "warning", "a", {"count": 0, "agreement": 0.3}, ("velocity_doubted", "")
    ),
    Code.SALVAGED: Finding(
        Code.SALVAGED,
        "warning",
        "a",
        {"salvaged": 70, "bytes_lost": 12, "occurrences": 1, "start": 20.0},
        ("end_missing", ""),
    ),
    Code.LEFT_OUT: Finding(
        Code.LEFT_OUT, "warning", "a", names=("holds no command", "inspect the recording")
    ),
    Code.FLIGHT_WORSE: Finding(
        Code.FLIGHT_WORSE, "warning", "a", {"before": 29.0, "after": 40.0}, ("attitude", "degrees")
    ),
    Code.FLIGHT_CRASHES: Finding(Code.FLIGHT_CRASHES, "warning", "a", {"seconds": 4.2}),
    Code.PART_FAILED: Finding(
        Code.PART_FAILED, "warning", "examination", names=("LinAlgError", "singular")
    ),
    Code.MISSING_SIGNALS: Finding(
        Code.MISSING_SIGNALS, "warning", "a", names=("rotor_speed", "command")
    ),
    Code.LIFTS_OTHERWISE: Finding(
        Code.LIFTS_OTHERWISE, "warning", "a, b", {"more": -0.13}, ("command", "battery")
    ),
    Code.WRONG_VEHICLE: Finding(
        Code.WRONG_VEHICLE, "warning", "quad", {"lift": 98.0, "weight": 0.33, "mass": 0.034}
    ),
    Code.CANNOT_HOVER: Finding(
        Code.CANNOT_HOVER,
        "warning",
        "quad",
        {"idle": 0.34, "full": 41.0, "weight": 0.33, "mass": 0.034},
    ),
    Code.MANOEUVRES_CHOSEN: Finding(
        Code.MANOEUVRES_CHOSEN, "info", "a", {"fitted": 2, "flights": 9}, ("a", "1", "4")
    ),
    Code.PX4_LOOPS: Finding(Code.PX4_LOOPS, "info", "a", names=("body_rate",)),
    Code.LOGGED_GAINS: Finding(
        Code.LOGGED_GAINS, "info", "a", names=("rate.roll.p 0.15 (MC_ROLLRATE_P)", "rate.rate 800")
    ),
    Code.LOGS_DIFFER: Finding(Code.LOGS_DIFFER, "warning", "flights", names=("MC_ROLLRATE_P",)),
    Code.POSE_GAP: Finding(Code.POSE_GAP, "warning", "a", {"seconds": 0.4}),
    Code.SPARSE_INPUT: Finding(
        Code.SPARSE_INPUT, "warning", "a", {"recorded": 20.0, "needed": 400.0}, ("command",)
    ),
    Code.DISTURBANCES_FOLLOWED: Finding(
        Code.DISTURBANCES_FOLLOWED,
        "info",
        "flights",
        {"wind": 0.1, "gust": 0.0027, "gust_seconds": 1.0, "thrust": 0.004, "thrust_seconds": 0.02},
    ),
    Code.INLET_CHOSEN: Finding(
        Code.INLET_CHOSEN,
        "info",
        "a",
        {"correlation": 0.02, "recorded": 45, "gyro": 49},
        ("attitude", "command"),
    ),
    Code.ATTITUDE_FOLLOWED: Finding(Code.ATTITUDE_FOLLOWED, "info", "a", names=("actuator",)),
    Code.SETPOINTS_SCALED: Finding(
        Code.SETPOINTS_SCALED,
        "warning",
        "a",
        {"gain": 2.0, "correlation": 0.98},
        ("roll", "rotation_matrix"),
    ),
    Code.SETPOINTS_BIASED: Finding(Code.SETPOINTS_BIASED, "info", "a", {"pitch": 0.08}),
    Code.SETPOINTS_LATE: Finding(Code.SETPOINTS_LATE, "info", "a", {"seconds": 0.06}),
    Code.SETPOINTS_FOREIGN: Finding(
        Code.SETPOINTS_FOREIGN, "warning", "a", {"roll": 0.1, "pitch": 0.2}
    ),
    Code.HEADING_FLOWN: Finding(Code.HEADING_FLOWN, "warning", "a", {"correlation": 0.1}),
    Code.MOTOR_ORDER: Finding(Code.MOTOR_ORDER, "warning", "a", names=("2", "4", "1", "3")),
    Code.SPINS_REVERSED: Finding(Code.SPINS_REVERSED, "warning", "a"),
    Code.SCALES_WITH_MASS: Finding(
        Code.SCALES_WITH_MASS, "info", "mass", {"mass": 0.03}, ("motor_constant", "inertia_xx")
    ),
    Code.NO_TACHOMETER: Finding(Code.NO_TACHOMETER, "info", "input_scaling"),
    Code.YAW_OPEN: Finding(Code.YAW_OPEN, "info", "inertia_zz"),
    Code.RATE_WORSE: Finding(
        Code.RATE_WORSE,
        "warning",
        "a",
        {"before": 7.6, "after": 8.2, "hold": 1.8, "seconds": 0.5},
    ),
    Code.RATE_PREDICTED: Finding(
        Code.RATE_PREDICTED,
        "info",
        "a",
        {"before": 7.6, "after": 5.2, "hold": 1.8, "seconds": 0.5},
    ),
    Code.RATE_NOT_PREDICTED: Finding(
        Code.RATE_NOT_PREDICTED,
        "info",
        "a",
        {"before": 7.6, "after": 5.2, "hold": 1.8, "seconds": 0.5},
    ),
    Code.VEHICLE_NOT_GIVEN: Finding(
        Code.VEHICLE_NOT_GIVEN, "warning", "hovergames", {"mass": 2.079}
    ),
    Code.SAME_RECORDING: Finding(Code.SAME_RECORDING, "warning", "b", names=("a",)),
    Code.DSHOT_OR_PULSES: Finding(
        Code.DSHOT_OR_PULSES, "warning", "a", {"pulses": 0.52, "dshot": 0.97}
    ),
    Code.SETTINGS_UNUSED: Finding(Code.SETTINGS_UNUSED, "warning", "mass"),
    Code.MASS_NOT_GIVEN: Finding(Code.MASS_NOT_GIVEN, "warning", "crazyflie", {"mass": 0.03}),
    Code.STILL_AXES: Finding(Code.STILL_AXES, "warning", "excitation", names=("x", "roll")),
    Code.NO_YAW: Finding(Code.NO_YAW, "warning", "excitation", {"rate": 0.1}),
    Code.IMPLAUSIBLE_BOUNDS: Finding(
        Code.IMPLAUSIBLE_BOUNDS,
        "warning",
        "time_constant_up",
        {"lower": 2.0, "upper": 3.0, "plausible_lower": 0.001, "plausible_upper": 1.0},
    ),
    Code.START_ON_BOUND: Finding(
        Code.START_ON_BOUND, "info", "actuator_latency", {"bound": 0.0, "start": 0.002}
    ),
    Code.NOT_FINITE: Finding(Code.NOT_FINITE, "failure", "simulation"),
    Code.NOTHING_HAS_EFFECT: Finding(Code.NOTHING_HAS_EFFECT, "failure", "coefficients"),
    Code.NO_EFFECT: Finding(Code.NO_EFFECT, "warning", "quadratic"),
    Code.SINGULAR_DIRECTION: Finding(
        Code.SINGULAR_DIRECTION, "warning", "coefficients", names=("mass", "inertia_xx")
    ),
    Code.SATURATION_FEEDBACK: Finding(
        Code.SATURATION_FEEDBACK, "warning", "saturation_feedback", {"feedback": 0.0}
    ),
    Code.SEES_MARKERS: Finding(Code.SEES_MARKERS, "warning", "sees_markers", {"seen": 1.0}),
    Code.CLOCK_OFFSET: Finding(
        Code.CLOCK_OFFSET, "info", "a", {"seconds": -0.012}, ("flight_controller",)
    ),
    Code.TURNING_UNEXPLAINED: Finding(
        Code.TURNING_UNEXPLAINED, "warning", "moments of inertia", {"explained": 0.41}
    ),
    Code.TURNING_REGRESSED: Finding(
        Code.TURNING_REGRESSED,
        "warning",
        "moments of inertia",
        {"explained_x": 0.54, "explained_y": 0.22, "explained_z": 0.94, "seconds": 0.5},
    ),
    Code.TURNING_NOT_PREDICTED: Finding(
        Code.TURNING_NOT_PREDICTED,
        "warning",
        "moments of inertia",
        {"explained_x": 0.1, "explained_y": 0.0, "explained_z": 0.3},
    ),
    Code.HOLDING_BETTER: Finding(
        Code.HOLDING_BETTER,
        "warning",
        "a",
        {"soonest": 0.1, "seconds": 0.1, "body_rate": 1.2, "body_rate_held": 0.9},
        ("body_rate",),
    ),
    Code.STAMPED_LATE: Finding(Code.STAMPED_LATE, "warning", "a", {"seconds": 0.19}, ("command",)),
    Code.INPUT_LATE: Finding(Code.INPUT_LATE, "info", "a", {"seconds": 0.012}),
    Code.GYRO_OFFSET: Finding(Code.GYRO_OFFSET, "info", "a", {"rate": 0.01}, ("gyro_x",)),
    Code.FLIGHT_NOT_FLOWN: Finding(
        Code.FLIGHT_NOT_FLOWN,
        "warning",
        "a",
        {"rmse": 0.29, "others": 0.011, "seconds": 12.5, "beyond": 0.5, "beyond_recorded": 0.01},
    ),
    Code.LAW_LACKING: Finding(
        Code.LAW_LACKING,
        "warning",
        "model",
        {"share": -0.09},
        ("force_z", "rotor_speed", "motor_constant", "input_scaling"),
    ),
    Code.CONTROLLER_ANSWERS: Finding(
        Code.CONTROLLER_ANSWERS,
        "warning",
        "controller file",
        {"roll": 1.05, "roll_error": 0.004},
        ("P", "roll"),
    ),
    Code.RATE_LOOP_DIFFERS: Finding(
        Code.RATE_LOOP_DIFFERS,
        "warning",
        "controller file",
        {"rate.rate": 250.0, "rate.rate_error": 0.0, "rate.rate_file": 400.0},
        ("rate.rate",),
    ),
    Code.ROTOR_SPEEDS_LATE: Finding(
        Code.ROTOR_SPEEDS_LATE, "warning", "rotor speeds", {"seconds": 0.009}
    ),
    Code.TERM_SHOWS: Finding(
        Code.TERM_SHOWS,
        "warning",
        "thrust_exponent",
        {"thrust_exponent": 1.93, "thrust_exponent_error": 0.004},
        ("thrust_exponent",),
    ),
    Code.ROTORS_STOP: Finding(
        Code.ROTORS_STOP, "warning", "motors", {"limit": 720.0, "allowed": 1100.0}
    ),
    Code.ROTORS_UNEQUAL: Finding(
        Code.ROTORS_UNEQUAL,
        "warning",
        "rotors",
        {"rotor_1": 1.17, "rotor_2": 0.85, "rotor_3": 1.17, "rotor_4": 0.86},
    ),
    Code.ROTOR_CHANGED: Finding(
        Code.ROTOR_CHANGED,
        "warning",
        "a",
        {"seconds": 22.0, "rotor": 1, "loss": 0.05},
        ("front right",),
    ),
    Code.FLIGHTS_DISAGREE: Finding(
        Code.FLIGHTS_DISAGREE,
        "warning",
        "a, b",
        {"difference": -0.019, "error": 0.0006},
        ("motor_constant",),
    ),
    Code.FLIGHT_UNMATCHED: Finding(
        Code.FLIGHT_UNMATCHED, "warning", "a", {"position": 90.0, "body_rate": 12.0}
    ),
    Code.MODEL_UNMATCHED: Finding(
        Code.MODEL_UNMATCHED,
        "warning",
        "model",
        {"unmatched": 3, "flights": 3, "noise_multiple": 35.0},
    ),
    Code.REFERENCE_VOLTAGE: Finding(
        Code.REFERENCE_VOLTAGE, "info", "input_scaling, zero_position_armed", {"volts": 16.36}
    ),
    Code.FLIGHTS_REFUTE: Finding(Code.FLIGHTS_REFUTE, "failure", "the fitted vehicle"),
    Code.FINER_THAN_STEPS: Finding(
        Code.FINER_THAN_STEPS, "warning", "estimate_latency", {"seconds": 1e-4}
    ),
    Code.POORLY_MET: Finding(
        Code.POORLY_MET, "warning", "a", {"noise_multiple": 40.0}, ("body_rate",)
    ),
    Code.GROUND_CONFLICT: Finding(
        Code.GROUND_CONFLICT,
        "warning",
        "motor_constant",
        {"deviation": 4.2, "ground": 1.5e-5, "flights": 1.4e-5, "mass": 2.1},
        ("N s²/rad²",),
    ),
    Code.BENCH_CONFLICT: Finding(
        Code.BENCH_CONFLICT, "warning", "torque_stand", {"deviation": 5.2}, ("motor_constant",)
    ),
    Code.STARTS_DISAGREE: Finding(
        Code.STARTS_DISAGREE, "info", "search", {"starts": 4, "changed": 1.0}
    ),
    Code.FLIGHTS_FAR_OFF: Finding(
        Code.FLIGHTS_FAR_OFF, "info", "search", {"far_off": 2, "flights": 2, "changed": 0.0}
    ),
}


@pytest.mark.parametrize("code", Code)
def test_every_finding_is_worded_in_whole_sentences(code):
    finding = MADE[code]
    text = sentence(finding)
    assert text[0].isupper()
    assert text.endswith(".")
    assert "{" not in text
    advice = remedy(finding)
    assert advice == "" or (advice[0].isupper() and advice.endswith("."))
    assert one_line(finding).startswith(f"{finding.level}: {finding.subject}: {text}")


def test_a_salvaged_recording_is_reported_with_its_numbers():
    text = sentence(MADE[Code.SALVAGED])
    assert "the end of the file is missing" in text
    assert "12 bytes lost; 70 messages salvaged; from t = 20.00 s" in text


def test_numbers_stand_in_the_unit_that_people_use():
    assert "-12.00 ms late" in sentence(MADE[Code.CLOCK_OFFSET])
    assert "flight controller clock" in sentence(MADE[Code.CLOCK_OFFSET])
    assert "0.2 ms" in remedy(MADE[Code.FINER_THAN_STEPS])
    assert "to the power 1.930 ± 0.004, slower" in sentence(MADE[Code.TERM_SHOWS])
    assert "a motor_constant that is 1.90 ± 0.06 % lower" in sentence(MADE[Code.FLIGHTS_DISAGREE])
    tilted = Code.FLIGHTS_DISAGREE.warning("a", "marker_tilt_z", "rad", difference=0.19, error=0.01)
    assert "a marker_tilt_z that is 0.19 ± 0.01 rad higher" in sentence(tilted)
    assert "--fix mass" in remedy(MADE[Code.SINGULAR_DIRECTION])
    assert "CMA-ES then searched more widely and ended lower" in sentence(
        MADE[Code.STARTS_DISAGREE]
    )


@pytest.mark.parametrize(
    ("lag", "says"),
    [
        (0.015, "rotor speeds are 15.0 ± 0.8 ms behind the rotors that turn the vehicle"),
        (-0.0025, "turning comes 2.5 ± 0.8 ms later than recorded rotor speeds say: the gyro"),
    ],
)
def test_a_lag_is_of_what_comes_late(lag: float, says: str) -> None:
    numbers = {"tachometer_lag": lag, "tachometer_lag_error": 8e-4}
    assert says in sentence(
        Finding(Code.TERM_SHOWS, "warning", "tachometer_lag", numbers, ("tachometer_lag",))
    )


@pytest.mark.parametrize(
    ("names", "says"),
    [
        (("attitude",), "Holding its attitude predicts it better 0.1 to 0.5 s ahead"),
        (("velocity", "body_rate"), "Holding its velocity and body rate predicts them better"),
        (tuple(PREDICTED_UNITS), "Holding its state predicts it better"),
    ],
)
def test_what_is_predicted_worse_than_held_is_named(names: tuple[str, ...], says: str) -> None:
    numbers = {"soonest": 0.1, "seconds": 0.5} | dict.fromkeys(names, 0.08)
    numbers |= {f"{name}_held": 0.0663 for name in names}
    found = sentence(Finding(Code.HOLDING_BETTER, "warning", "a", numbers, names))
    assert found.startswith(says)
    assert found.count("instead of 0.0663") == len(names)


def test_what_holds_of_several_flights_but_for_numbers_is_said_once():
    def scaled(flight, axis, gain):
        numbers = {"gain": gain, "correlation": 0.9}
        return Finding(Code.SETPOINTS_SCALED, "warning", flight, numbers, (axis, ""))

    roll, pitch = scaled("a", "roll", 0.23), scaled("a", "pitch", 0.23)
    said = merge_alike([roll, pitch, scaled("b", "roll", 0.25), scaled("b", "roll", 2.0)])
    assert [(one.subject, one.names[0]) for one in said] == [("a, b", "roll"), ("a", "pitch")]
    assert shorten_finding(said[0], 98).startswith(
        "a and 1 more: Roll rate set-points are 0.2 times"
    )
