"""Sentences of findings that need more than a text with numbers in braces."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from tuner.core.phrases import as_sentence, listed, percent, with_error
from tuner.recordings.notes import Cause, Damage, Note, NoteCode, damage_sentence, note_in_words
from tuner.vehicle.controller import PARAMETER_OF

if TYPE_CHECKING:
    from tuner.findings.findings import Finding

Numbers = Mapping[str, float]

VERBS_OF_FILES = {"cannot", "claims", "extends", "has", "holds", "is", "keeps", "lacks"}
"""An error that begins with one of these has a file as its subject."""


PREDICTED_UNITS: Mapping[str, str] = {
    "position": "m",
    "velocity": "m/s",
    "attitude": "rad",
    "body_rate": "rad/s",
}
"""Predicted quantity -> its unit."""

FEATURE_PHRASES: Mapping[str, str] = {
    "airspeed": "the airspeed along it",
    "airspeed_squared": "the square of the airspeed along it",
    "airspeed_across": "the airspeed across it",
    "rate": "the body rate about it",
    "rate_squared": "the square of the body rate about it",
    "other_rates": "the product of the other two body rates",
}
"""Regressor of `tuner.equation_error.omitted_laws` -> its phrase."""
TERMS_OF_LAW: Mapping[tuple[str, str], tuple[str, ...]] = {
    ("force", "airspeed"): ("rotor_drag_ratio", "linear_drag", "thrust_inflow"),
    ("force", "airspeed_squared"): ("fuselage_drag",),
    ("moment", "airspeed_across"): ("flapping_moment", "center_of_mass"),
    ("moment", "airspeed"): ("flapping_moment", "center_of_mass"),
    ("moment", "rate"): ("angular_drag", "thrust_inflow"),
    ("moment", "other_rates"): ("center_of_mass",),
}
"""Force or moment, and its regressor -> groups of terms with that law."""


def recording(finding: Finding) -> str:
    """Return the sentence of a note on a recording."""
    code, topic, *names = finding.names
    numbers = dict(finding.numbers)
    count = int(numbers.pop("count"))
    text = note_in_words(Note(NoteCode(code), "warning", topic, count, numbers, tuple(names)))
    return f"{topic}: {text}." if topic else as_sentence(text)


CONTROLLER_FILE = "controller file"
"""Subject of what all flights say of the rate controller; one flight's has that one's name."""


def left_out(finding: Finding) -> str:
    """Return why a flight is left out; it is the subject of a clause without one."""
    what = finding.names[0]
    it = "it " if what.split()[0] in VERBS_OF_FILES else ""
    return as_sentence(f"{it}{what}; the flight is left out")


def salvaged(finding: Finding) -> str:
    """Return a sentence on the damage of a recording."""
    cause, subject = finding.names
    numbers: Mapping[str, Any] = finding.numbers
    damage = damage_sentence(Damage(Cause(cause), subject, **numbers))
    return f"It is broken: {damage}; what was salvaged is used."


def different_thrust(finding: Finding) -> str:
    """Return possible causes of another thrust in these flights, and its ratio."""
    signal, *others = finding.names
    more = finding.numbers["more"]
    return (
        f"Another {', '.join([*others, 'payload', 'propeller'])} or vehicle flew: at the same "
        f"{signal.replace('_', ' ')}s rotors lift {percent(abs(more))} "
        f"{'more' if more > 0.0 else 'less'} of the weight than in the other flights."
    )


def ground_conflict(finding: Finding) -> str:
    """Return the values from ground and flights, and the mass for which they agree."""
    numbers, (unit,) = finding.numbers, finding.names
    apart = f"{numbers['deviation']:+.1f} standard errors apart, model error included."
    ground, flights = (f"{numbers[name]:.5g} {unit}" for name in ("ground", "flights"))
    if "mass" not in numbers:
        return f"Ground and flights disagree: {ground} and {flights}, {apart}"
    return (
        f"Ground and flights agree at {numbers['mass']:.4g} kg alone: with the mass given it is "
        f"{ground} on the ground and {flights} in flight, {apart}"
    )


def inlet_chosen(finding: Finding) -> str:
    """Return why a flight has an inlet further down the loop than recorded."""
    inlet, signal, *order = finding.names
    numbers = finding.numbers
    read = " in the order in which it is read" if order else ""
    unexplained = (
        f"the {signal.replace('_', ' ')}, logged at {numbers['recorded']:.0f} Hz, does not explain "
        f"how the vehicle turned{read} (correlation {numbers['correlation']:.2f} with its angular "
        "acceleration), so that"
    )
    if inlet == "attitude":
        return (
            f"Nothing of its turning is fitted: {unexplained} its recorded attitude is followed "
            "and only its translation simulated."
        )
    return as_sentence(f"{unexplained} it is simulated from its rotor speeds")


def setpoints_scaled(finding: Finding) -> str:
    """Return the factor by which set-points differ, and the law that would explain it."""
    axis, law = finding.names
    so = f", as those of the {law} law would be" if law else ""
    if axis == "thrust":
        factor = f"{finding.numbers['gain']:.2f}"
        return f"Thrust set-points follow reference and state {factor} times as the file's would."
    factor = f"{finding.numbers['gain']:.1f}"
    return f"{axis.capitalize()} rate set-points are {factor} times the controller file's{so}."


def setpoints_biased(finding: Finding) -> str:
    """Return by how much the rate set-points of each axis are off."""
    off = listed([f"{bias:+.3f} rad/s in {axis}" for axis, bias in finding.numbers.items()])
    return (
        f"Recorded rate set-points are off the controller file's by {off}, as where the recorded "
        "attitude is tilted against the one that was controlled."
    )


def setpoints_foreign(finding: Finding) -> str:
    """Return on which axes set-points do not follow."""
    alike = " and ".join(f"{value:.2f} in {axis}" for axis, value in finding.numbers.items())
    return (
        "Another controller flew, or another reference: the recorded rate set-points do not follow "
        f"from reference, state and controller file (correlation {alike})."
    )


def worse_than_hold(finding: Finding) -> str:
    """Return the quantities that a constant state predicts better."""
    numbers, names = finding.numbers, finding.names
    lost = listed(
        [
            f"{name.replace('_', ' ')} by {numbers[name]:.3g} {unit} instead of "
            f"{numbers[f'{name}_held']:.3g} {unit}"
            for name, unit in PREDICTED_UNITS.items()
            if name in names
        ]
    )
    some = listed([name.replace("_", " ") for name in names])
    what = "state" if set(names) == set(PREDICTED_UNITS) else some
    it = "it" if len(names) in (1, len(PREDICTED_UNITS)) else "them"
    ahead = " to ".join(dict.fromkeys(f"{numbers[end]:g}" for end in ("soonest", "seconds")))
    return (
        f"Holding its {what} predicts {it} better {ahead} s ahead: the fitted coefficients then "
        f"miss {lost} in the mean."
    )


def estimated_disturbances(finding: Finding) -> str:
    """Return standard deviations and correlation times of the estimated disturbances."""
    numbers = finding.numbers
    return (
        "The residuals hold more than measurement noise, as in gusts: an extended Kalman filter "
        f"estimates wind that varies by {numbers['wind']:.2g} m/s and pushes by another "
        f"{100.0 * numbers['gust']:.2g} % of the weight (correlation time "
        f"{numbers['gust_seconds']:.2g} s) and thrust that varies by "
        f"{100.0 * numbers['thrust']:.2g} % ({1e3 * numbers['thrust_seconds']:.0f} ms). The "
        "coefficients are those that predict each sample best from the samples before."
    )


def flight_not_followed(finding: Finding) -> str:
    """Return the time at which the loop leaves a flight, and whether it is at its limit."""
    numbers = finding.numbers
    limit = ""
    if "beyond" in numbers:
        limit = (
            " Its position control asks for more than max_feedback_acceleration "
            f"{percent(numbers['beyond'])} of the time, the recorded flight's "
            f"{percent(numbers['beyond_recorded'])}: beyond that limit the loop does not come back."
        )
    return (
        f"The fitted model does not fly this flight: position RMSE {numbers['rmse']:.2g} m, of the "
        f"others {numbers['others']:.2g} m. It leaves the recorded one at t = "
        f"{numbers['seconds']:.1f} s.{limit}"
    )


def missing_law(finding: Finding) -> str:
    """Return the law that the model lacks, and the coefficients whose intervals include it."""
    axis, feature, *moved = finding.names
    what, along = axis.split("_")
    share = finding.numbers["share"]
    if feature == "rotor_speed":
        slower = "less" if share < 0.0 else "more"
        law = f"thrust that grows {slower} with rotor speed than its law has it"
    else:
        goes = "against" if share < 0.0 else "with"
        kind = "force along" if what == "force" else "moment about"
        with_what = FEATURE_PHRASES[feature]
        if feature == "airspeed_across" and axis == "force_z":
            lift = ", as translational lift does" if share > 0.0 else ""
            with_what = f"the square of the airspeed across it{lift}"
        law = f"a {kind} body {along} that goes {goes} {with_what}"
    return (
        f"The model lacks {law}: it makes {percent(abs(share))} of what varies there in the "
        f"recorded accelerations. It may have moved {listed(moved)}, whose intervals hold that."
    )


def missing_law_remedy(finding: Finding) -> str:
    """Return the terms with that law."""
    axis, feature, *_ = finding.names
    terms = TERMS_OF_LAW.get((axis[:-2], feature))
    if terms is None:
        return "No term has that law: judge the fit by the held-out flights."
    return f"Name under terms in the job what of that kind the vehicle has: {listed(terms)}."


def controller_gains_differ(finding: Finding) -> str:
    """Return the rate controller's gain by its recorded commands, on each axis."""
    part, *axes = finding.names
    numbers = finding.numbers
    if part == "late":
        parts = [
            f"{axis} answers its gyro {_milliseconds(numbers, axis)} "
            f"{'later' if numbers[axis] > 0.0 else 'earlier'}"
            for axis in axes
        ]
        than = "than the simulated filters and D let it"
    else:
        parts = [f"{axis} reacts as if its {part} were {_excess(numbers, axis)}" for axis in axes]
        than = "than simulated"
    difference = f"{listed(parts)} {than}, by the recorded commands"
    if finding.subject != CONTROLLER_FILE:
        return as_sentence(f"{difference}, and the other flights do not")
    return as_sentence(f"{difference}; intervals hold what that moves")


def rate_loop_differs(finding: Finding) -> str:
    """Return the settings of the rate loop with which recorded commands were made."""
    numbers, parts = finding.numbers, []
    for name in finding.names:
        unit = " Hz" if name == "rate.rate" or name.endswith("cutoff") else ""
        value, error, of_file = (numbers[f"{name}{of}"] for of in ("", "_error", "_file"))
        known = with_error(value, error) if error else f"{value:g}"
        parts.append(f"{name} {known}{unit} instead of {of_file:g}{unit}")
    return (
        "Another rate loop flew than the controller file's: from recorded set-points and body "
        f"rates, it gave the recorded motor commands with {listed(parts)}."
    )


def rate_loop_remedy(finding: Finding) -> str:
    """Return the autopilot's parameters by which the controller file is to be corrected."""
    parameters = [PARAMETER_OF[tuple(name.split("."))] for name in finding.names]
    return (
        f"Correct the controller file by the autopilot's parameters ({', '.join(parameters)}), and "
        "fit again."
    )


def rotor_speeds_late(finding: Finding) -> str:
    """Return the delay between rotor speeds and angular acceleration."""
    seconds = finding.numbers["seconds"]
    after = "after" if seconds > 0.0 else "before"
    return (
        f"Recorded rotor speeds come {1e3 * abs(seconds):.2g} ms {after} the turning that they "
        "make: they were filtered, or are stamped otherwise than the gyro. Intervals hold what "
        "that moves."
    )


def rotor_changed(finding: Finding) -> str:
    """Return rotor, time and size of a change of thrust within a flight."""
    loss, (place,) = finding.numbers["loss"], finding.names
    change = f"{100.0 * abs(loss):.0f} % {'less' if loss > 0.0 else 'more'}"
    seconds = finding.numbers["seconds"]
    return (
        f"From t = {seconds:.1f} s of this flight rotor {finding.numbers['rotor']:.0f} ({place}) "
        f"gives {change} thrust at the same speed than before: the flight is used up to there."
    )


def _thrust_exponent(numbers: Numbers) -> str:
    value, error = numbers["thrust_exponent"], numbers["thrust_exponent_error"]
    slower = "slower" if value < 2.0 else "faster"
    return (
        f"Thrust and drag torque grow as the rotor speed to the power {with_error(value, error)}, "
        f"{slower} than with its square."
    )


def _motor_lag(numbers: Numbers) -> str:
    before = "a second lag" if numbers["time_constant_second"] > 0.0 else "a lead"
    of = _milliseconds(numbers, "time_constant_second")
    return f"Rotors follow as if {before} of {of} stood before their own."


def _rate_gain(numbers: Numbers) -> str:
    axes = {"rate_gain_roll_pitch": "roll and pitch react", "rate_gain_yaw": "yaw reacts"}
    parts = [
        f"{reacts} as if the rate controller's P, I and D were {_excess(numbers, name)}"
        for name, reacts in axes.items()
        if name in numbers
    ]
    return as_sentence(f"{listed(parts)} than in the controller file")


def _integral_gain(numbers: Numbers) -> str:
    excess = _excess(numbers, "integral_gain")
    return f"The rate controller's I is {excess} than in the controller file."


def _gyro_filter(numbers: Numbers) -> str:
    excess = _excess(numbers, "gyro_cutoff_factor")
    return f"The gyro's low-pass filter cuts off {excess} than in the controller file."


def _derivative_filter(numbers: Numbers) -> str:
    excess = _excess(numbers, "derivative_cutoff_factor")
    return (
        f"The filter of the rate controller's derivative cuts off {excess} than in the controller "
        "file."
    )


def _attitude_gain(numbers: Numbers) -> str:
    excess = _excess(numbers, "attitude_gain")
    return f"The attitude controller's gain is {excess} than in the controller file."


def _autopilot_tilt(numbers: Numbers) -> str:
    parts = [
        f"by {with_error(*(math.degrees(numbers[key]) for key in (name, f'{name}_error')))}° about "
        f"the axis that points {axis}"
        for name, axis in (("autopilot_tilt_x", "forward"), ("autopilot_tilt_y", "left"))
        if name in numbers
    ]
    return f"The autopilot's axes are turned against the vehicle's: {listed(parts)}."


def _gyro_scale(numbers: Numbers) -> str:
    axes = {"gyro_scale_x": "roll", "gyro_scale_y": "pitch", "gyro_scale_z": "yaw"}
    parts = [
        f"{_excess(numbers, name, ('more', 'less'))} in {axis}"
        for name, axis in axes.items()
        if name in numbers
    ]
    return f"The gyro reads {listed(parts)} than the recorded attitude turns."


def _tachometer_lag(numbers: Numbers) -> str:
    late = _milliseconds(numbers, "tachometer_lag")
    if numbers["tachometer_lag"] > 0.0:
        return (
            f"Recorded rotor speeds are {late} behind the rotors that turn the vehicle: they look "
            "filtered."
        )
    return (
        f"The turning comes {late} later than recorded rotor speeds say: the gyro looks filtered, "
        "or is stamped late."
    )


def _excess(numbers: Numbers, name: str, words: tuple[str, str] = ("higher", "lower")) -> str:
    """Return the difference of a factor from one, in percent with its standard error."""
    more, error = 100.0 * (numbers[name] - 1.0), 100.0 * numbers[f"{name}_error"]
    return f"{with_error(abs(more), error)} % {words[more <= 0.0]}"


def _milliseconds(numbers: Numbers, name: str) -> str:
    """Return the size of a time in ms with its standard error."""
    return f"{with_error(1e3 * abs(numbers[name]), 1e3 * numbers[f'{name}_error'])} ms"


def term_shows(finding: Finding) -> str:
    """Return what a term says, and what may act in its place."""
    sentence = TERM_SENTENCES[finding.subject][0](finding.numbers)
    own = (*finding.names, *(f"{name}_error" for name in finding.names))
    others = [f"{name} = {v:.3g}" for name, v in finding.numbers.items() if name not in own]
    if not others:
        return sentence
    return f"{sentence} Or it does not, and {listed(others)}: these flights do not tell which."


TERM_SENTENCES: Mapping[str, tuple[Callable[[Numbers], str], str]] = {
    "thrust_exponent": (
        _thrust_exponent,
        "Check it on a thrust stand; simulators without such a term are right at the hover alone.",
    ),
    "motor_lag": (
        _motor_lag,
        "Look at what smooths commands: speed controllers, IMU_GYRO_CUTOFF, a bridge.",
    ),
    "rate_gain": (
        _rate_gain,
        "Compare it with the autopilot's parameters (MC_ROLLRATE_K, _P, MC_BAT_SCALE_EN).",
    ),
    "integral_gain": (
        _integral_gain,
        "Compare it with the autopilot's parameters (MC_ROLLRATE_I, MC_PITCHRATE_I, MC_YAWRATE_I).",
    ),
    "gyro_filter": (_gyro_filter, "Compare it with the autopilot's IMU_GYRO_CUTOFF."),
    "derivative_filter": (
        _derivative_filter,
        "Compare it with the autopilot's IMU_DGYRO_CUTOFF.",
    ),
    "attitude_gain": (
        _attitude_gain,
        "Compare attitude.time_constant with the controller that flew (MC_ROLL_P, MC_PITCH_P).",
    ),
    "autopilot_tilt": (
        _autopilot_tilt,
        "Mount it straight, or calibrate its level (SENS_BOARD_X_OFF, SENS_BOARD_Y_OFF).",
    ),
    "gyro_scale": (_gyro_scale, "Calibrate the gyro, or compare it with another."),
    "tachometer_lag": (_tachometer_lag, "Log both unfiltered, by one clock."),
}
"""Group of terms -> its sentence, and the remedy."""


def flights_disagree(finding: Finding) -> str:
    """Return by how much another value of a coefficient some flights call for."""
    difference, error = (finding.numbers[of] for of in ("difference", "error"))
    (name, *unit), size = finding.names, 1.0 if finding.names[1:] else 100.0
    return (
        f"Flights disagree: these call for a {name} that is "
        f"{' '.join([with_error(size * abs(difference), size * error), *(unit or '%')]).strip()} "
        f"{'higher' if difference > 0.0 else 'lower'} than the others'."
    )


def flight_unmatched(finding: Finding) -> str:
    """Return the residuals of each channel of a flight over the noise."""
    multiples = ", ".join(
        f"{channel.replace('_', ' ')} {value:.1f}" for channel, value in finding.numbers.items()
    )
    return (
        "The simulation does not match it: its residuals in multiples of the measurement noise are "
        f"{multiples}, and its weight in the fit was lowered accordingly."
    )
