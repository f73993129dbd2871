"""Findings as sentences: what was noticed, and what to do about it."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping

from tuner.core.findings import Code, Finding
from tuner.core.phrases import as_sentence, listed, percent, shorten
from tuner.vehicle.motor_orders import order_in_words
from tuner.wording import composed

GIVE_VEHICLE = (
    "Give the vehicle with --vehicle and what it weighs with --mass; tune new-vehicle writes a "
    "starting file from its mass, size and propellers."
)


CLAUSE = re.compile(r"[;.] | \(|, (?=and|as|at|or|if)|: (?!false|true)(?=[a-z0-9]+ )")
"""Where the first clause of a sentence ends; not before the value of a setting."""
Text = str | Callable[[Finding], str]
"""With the finding's numbers in braces, ``names``, ``first`` and ``last`` for its names in words,
``coefficients`` and ``given`` for them as they stand, ``subject`` for its subject; or what makes a
sentence of a finding."""
#: Code -> what was noticed, and what to do about it.
TEXTS: Mapping[Code, tuple[Text, Text]] = {
    Code.FLIGHT_WORSE: (
        (
            "Its {first} is met worse than before the fit: RMSE {after:.3g} {unit}, before "
            "{before:.3g} {unit}."
        ),
        "Look at its figures and at inspect: it may have been flown, or recorded, otherwise.",
    ),
    Code.FLIGHT_CRASHES: (
        (
            "The simulated flight crashes after {seconds:.1f} s: with the initial coefficients it "
            "does not."
        ),
        "Do not use this fit: free other coefficients, and look at inspect.",
    ),
    Code.PART_FAILED: (
        (
            "This part failed and is left out: {given}, {text}. The rest of the result does not "
            "depend on it."
        ),
        "Please report it, with the job's log.",
    ),
    Code.MISSING_SIGNALS: (
        ("It holds no {names}: the flight says less about the motors, and about inertia."),
        "Log that too, if you can.",
    ),
    Code.WRONG_VEHICLE: (
        (
            "This is not the vehicle that flew: turning as recorded, its rotors would lift "
            "{lift:.3g} N on average, and {mass:g} kg weigh {weight:.3g} N."
        ),
        GIVE_VEHICLE,
    ),
    Code.CANNOT_HOVER: (
        (
            "This is not the vehicle that flew: {mass:g} kg weigh {weight:.3g} N, and its rotors "
            "lift {idle:.3g} N idling, {full:.3g} N at full command."
        ),
        GIVE_VEHICLE,
    ),
    Code.POSE_GAP: (
        "No pose was recorded for {seconds:.2f} s during the mission.",
        "Check the cameras' view and the network.",
    ),
    Code.SPARSE_INPUT: (
        (
            "The {first} comes at {recorded:.0f} of {needed:.0f} Hz: what happened in between is "
            "lost, and moments of inertia may be wrong by tens of percent, more than their "
            "intervals show."
        ),
        "Log it at the full rate, or choose an inlet further upstream.",
    ),
    Code.STILL_AXES: (
        "No flight moves in {names}: inertia and rotor drag there are not excited.",
        "Fly a circle or a lemniscate.",
    ),
    Code.NO_YAW: (
        (
            "No flight yaws faster than {rate:.2f} rad/s: inertia_zz and moment_constant are not "
            "excited."
        ),
        "Fly a yaw spin.",
    ),
    Code.IMPLAUSIBLE_BOUNDS: (
        (
            "The bounds {lower:g} to {upper:g} exclude every plausible value "
            "({plausible_lower:g} to {plausible_upper:g})."
        ),
        "Widen them.",
    ),
    Code.START_ON_BOUND: (
        "The initial value {bound:g} lies on a bound; the search starts at {start:.3g}.",
        "",
    ),
    Code.NOT_FINITE: (
        "The simulation with the initial coefficients does not stay finite.",
        "Check the vehicle and controller files.",
    ),
    Code.NOTHING_HAS_EFFECT: (
        "No free coefficient has an effect on any recorded signal.",
        "Use flights that move, or other channels.",
    ),
    Code.NO_EFFECT: (
        "The coefficient has no effect on any recorded signal.",
        "Fix it with --fix {subject}, or record a signal that it acts on.",
    ),
    Code.SINGULAR_DIRECTION: (
        (
            "The flights do not tell them apart: a common change of {coefficients} leaves every "
            "recorded signal as it is."
        ),
        "Fix one of them to its measured value (--fix {given}).",
    ),
    Code.CLOCK_OFFSET: (
        "The {first} clock is {milliseconds:+.2f} ms late, which the fit takes into account.",
        "",
    ),
    Code.TURNING_UNEXPLAINED: (
        (
            "Inputs explain {explained_percent} of the turning: that share of the change of body "
            "rate over half a second. Noise in them, and the loop's answer to disturbances, make "
            "their torque look weaker than it is: inertia and lags are those that predict best, "
            "and inertia may be several times too large, whatever its interval says."
        ),
        "Log inputs at the rate loop's rate, or measure the inertia on the ground (tune bench).",
    ),
    Code.TURNING_REGRESSED: (
        (
            "Not all turning is recorded: rotor speeds and forces of the air explain "
            "{explained_x_percent}, {explained_y_percent} and {explained_z_percent} of the angular "
            "acceleration about forward, left and up. The rest is not recorded, and the loop's "
            "rotors answer it. Moments of inertia and other physical coefficients are those of a "
            "regression of accelerations that the answer does not bend. Torque gains, damping and "
            "steady torque are not physical, but what predicts up to {seconds:g} s ahead best."
        ),
        "Fly faster and less evenly, or measure the inertia on the ground (tune bench).",
    ),
    Code.TURNING_NOT_PREDICTED: (
        (
            "Most turning is not recorded: rotor speeds and forces of the air explain "
            "{explained_x_percent}, {explained_y_percent} and {explained_z_percent} of the angular "
            "acceleration about forward, left and up, too little to predict roll and pitch 0.1 s "
            "ahead better than that they stay. Physical coefficients are those of a regression of "
            "accelerations."
        ),
        "Feed the attitude in (inlet: attitude), or log what the loop is told to do.",
    ),
    Code.HOLDING_BETTER: (
        composed.holding_better,
        "Predict less far ahead, or with more recorded.",
    ),
    Code.INPUT_LATE: (
        (
            "What is fed into the simulation is stamped {milliseconds:+.2f} ms late against the "
            "recorded state, which the fit takes into account."
        ),
        "",
    ),
    Code.GYRO_OFFSET: (
        "The {first} reads {rate:+.4f} rad/s at rest, which the fit takes into account.",
        "",
    ),
    Code.MODEL_UNMATCHED: (
        (
            "It lacks an effect that flights share: the residuals of {unmatched:.0f} of "
            "{flights:.0f} flights are about {noise_multiple:.0f} times the measurement noise."
        ),
        "Judge the fit by held-out flights, not by its intervals.",
    ),
    Code.FINER_THAN_STEPS: (
        (
            "Simulators differ by {milliseconds:g} ms: their physics steps do, which the 95 % "
            "intervals of these lags leave out."
        ),
        "Take these values as known to {twice:g} ms.",
    ),
    Code.REFERENCE_VOLTAGE: (
        (
            "They are those at {volts:.2f} V, the highest voltage of these flights without load: "
            "the vehicle file names no other."
        ),
        "Give battery.reference_voltage in the vehicle file for those at another voltage.",
    ),
    Code.POORLY_MET: (
        (
            "Its {first} is {noise_multiple:.0f} times the noise off: intervals are widened "
            "accordingly."
        ),
        "Fit first, then examine the fitted vehicle.",
    ),
    Code.GROUND_CONFLICT: (
        (
            "Ground and flights disagree: {ground:.5g} {unit} and {flights:.5g} {unit}, "
            "{deviation:+.1f} standard errors apart, model error included."
        ),
        "Find out which is wrong, the rig or the model.",
    ),
    Code.BENCH_CONFLICT: (
        (
            "It contradicts the other experiments: what it says of {coefficients} lies "
            "{deviation:+.1f} standard errors from theirs."
        ),
        "Check its geometry (levers, arms, wires), its units and its calibration.",
    ),
    Code.SETPOINTS_BIASED: (
        "The recorded {first} rate set-points are {bias:+.3f} rad/s off the controller file's.",
        "",
    ),
    Code.SETPOINTS_LATE: (
        (
            "The recorded rate set-points are those of the controller file to a state that is "
            "{milliseconds:.0f} ms old: a slow estimator, a filter or late stamps lie between."
        ),
        "Check the stamps of pose and set-points; the fit takes it for estimate_latency.",
    ),
    Code.HEADING_FLOWN: (
        (
            "The heading was commanded otherwise, as by hand: recorded yaw rate set-points do not "
            "follow from the controller file (correlation {correlation:.2f}), so that the "
            "reference says nothing of it."
        ),
        "Feed in its rate set-points (inlet: body_rate) if yaw matters.",
    ),
    Code.MOTOR_ORDER: (
        (
            "Motors are in another order: how they turn the vehicle makes them {names} of the "
            "columns that the topic map lists."
        ),
        "Write motor_order: {order} into the topic map.",
    ),
    Code.SPINS_REVERSED: (
        "Motors yaw it against the spins of the vehicle file.",
        "Check the spins, the motors' order, and the sign of the gyro's z.",
    ),
    Code.SCALES_WITH_MASS: (
        (
            "Without a pose the flights show {coefficients} over the mass alone; they hold for "
            "{mass:g} kg, and go with it."
        ),
        "Weigh the vehicle (--mass): that, or one measured inertia, closes the scale.",
    ),
    Code.NO_TACHOMETER: (
        (
            "No rotor speed was recorded: the curve from command to rotor speed stays as it is, "
            "and motor_constant goes with the inverse square of input_scaling."
        ),
        "One tachometer reading at a known command closes that; thrust and torque do not need it.",
    ),
    Code.YAW_OPEN: (
        "The flights show moment_constant over inertia_zz, and not each of them.",
        "Measure one of the two: a bifilar pendulum gives inertia_zz (tune bench).",
    ),
    Code.RATE_WORSE: (
        (
            "Its body rate is predicted worse than before: {seconds:g} s ahead, from its commands "
            "alone, to {after:.3g} rad/s instead of {before:.3g} rad/s."
        ),
        "Fit it by itself: another build, battery or propeller turns the vehicle otherwise.",
    ),
    Code.RATE_FORETOLD: (
        (
            "From its commands alone the fitted coefficients predict the body rate of this flight, "
            "which was held out, {seconds:g} s ahead to {after:.3g} rad/s; the initial ones do to "
            "{before:.3g} rad/s, and that it stays as it is would be right to {hold:.3g} rad/s."
        ),
        "",
    ),
    Code.RATE_NOT_FORETOLD: (
        (
            "From its commands alone the fitted coefficients predict the body rate of this flight "
            "{seconds:g} s ahead to {after:.3g} rad/s ({before:.3g} rad/s with the initial ones), "
            "and that it stays as it is would be right to {hold:.3g} rad/s: commands answer "
            "disturbances that are not recorded, and an open loop adds them up."
        ),
        "Predict less far ahead, or simulate the loop that flew.",
    ),
    Code.VEHICLE_NOT_GIVEN: (
        (
            "No vehicle was given: these flights were taken for its own, and without a pose mass "
            "and arms come from the vehicle file."
        ),
        "Give the vehicle with --vehicle, and what it weighs with --mass.",
    ),
    Code.STARTS_DISAGREE: (
        "No two of {starts:.0f} starts ended in the same minimum; {second_search}.",
        "",
    ),
    Code.FLIGHTS_FAR_OFF: (
        (
            "The simulation of {far_off:.0f} of {flights:.0f} flights stayed far from the "
            "recording; {second_search}."
        ),
        "",
    ),
    Code.RECORDING: (composed.recording, ""),
    Code.LEFT_OUT: (
        composed.left_out,
        lambda finding: as_sentence(finding.names[1]),
    ),
    Code.SALVAGED: (composed.salvaged, "Record the flight again if what was lost matters."),
    Code.SATURATION_FEEDBACK: (
        (
            "The mixer was another: the recordings agree with one that {mixer} at the rotors' "
            "lower limit, other than the controller file has it. It was simulated so."
        ),
        "Set mixer.saturation_feedback: {flag} (in the controller file).",
    ),
    Code.SEES_MARKERS: (
        (
            "The controllers see another frame: the recordings agree with ones that see {frame}, "
            "other than the controller file has it. It was simulated so."
        ),
        "Set sensing.sees_markers: {seen_flag} (in the controller file).",
    ),
    Code.FLIGHT_UNMATCHED: (
        composed.flight_unmatched,
        "Look at its figures: the controller, the clock, wind, damage or the vehicle may differ.",
    ),
    Code.INLET_CHOSEN: (composed.inlet_chosen, composed.inlet_remedy),
    Code.MANOEUVRES_CHOSEN: (
        (
            "It is long: {fitted:.0f} of its {flights:.0f} manoeuvres are fitted, those that show "
            "most (missions {others})."
        ),
        "Name others under 'missions' in its side-car, {first}.yaml.",
    ),
    Code.PX4_LOOPS: (
        (
            "PX4's own position and attitude control flew it, other loops than the geometric ones "
            "that are simulated: it enters below them, through the inlet {first}."
        ),
        "",
    ),
    Code.LOGGED_GAINS: (
        "The rate loop is simulated with the log's own parameters: {coefficients}.",
        "",
    ),
    Code.LOGS_DIFFER: (
        "The logs differ: in {coefficients}; those of the first are simulated.",
        "Fit them one by one.",
    ),
    Code.ATTITUDE_FOLLOWED: (
        (
            "The recorded attitude of all fitted flights is followed, so that nothing is fitted of "
            "how the vehicle turns: that of this flight is followed, too."
        ),
        "",
    ),
    Code.DISTURBANCES_FOLLOWED: (composed.disturbances_followed, ""),
    Code.INERTIA_BALANCED: (composed.inertia_balanced, ""),
    Code.INERTIA_NOT_BALANCED: (
        composed.inertia_balanced,
        "Take these inertias for effective ones, and measure them on the ground (tune bench).",
    ),
    Code.ROTOR_CHANGED: (
        composed.rotor_changed,
        "Look at its propeller, motor and mount before you fly again.",
    ),
    Code.SETPOINTS_SCALED: (composed.setpoints_scaled, composed.setpoints_remedy),
    Code.SETPOINTS_FOREIGN: (
        composed.setpoints_foreign,
        "Give the controller that flew (--controller), or enter below it (inlet: body_rate).",
    ),
}


def sentence(finding: Finding) -> str:
    """Return what was noticed, as a sentence."""
    return _worded(TEXTS[finding.code][0], finding)


def remedy(finding: Finding) -> str:
    """Return what to do about it, as a sentence; empty if there is nothing to do."""
    return _worded(TEXTS[finding.code][1], finding)


def one_line(finding: Finding) -> str:
    """Return a finding as one line of a terminal."""
    return f"{finding.level}: {finding.subject}: {sentence(finding)} {remedy(finding)}".rstrip()


def brief(finding: Finding, width: int) -> str:
    """Return a finding in so many characters: its subject, what was noticed, what to do.

    What does not fit is cut from the middle, what to do last.
    """
    first, *others = finding.subject.split(", ")
    subject = shorten(f"{first} and {len(others)} more" if others else first, 30)
    what, to_do = CLAUSE.split(sentence(finding))[0].removesuffix("."), remedy(finding)
    if len(f"{subject}: {what}. {to_do}") > width and to_do:
        to_do = f"{CLAUSE.split(to_do)[0].removesuffix('.')}."
    left = width - len(f"{subject}: . {to_do}")
    return shorten(f"{subject}: {shorten(what, max(left, 12))}. {to_do}".rstrip(), width)


def _worded(text: Text, finding: Finding) -> str:
    return text.format(**_values(finding)) if isinstance(text, str) else text(finding)


def _values(finding: Finding) -> dict[str, object]:
    names, numbers = [name.replace("_", " ") for name in finding.names], finding.numbers
    values: dict[str, object] = {"subject": finding.subject, **numbers}
    if names:
        values["others"] = listed(names[1:] or names)
        values |= {"names": listed(names), "first": names[0], "last": names[-1]}
        values |= {"coefficients": listed(finding.names), "given": finding.names[0]}
        values["text"] = finding.names[-1]
        values["unit"] = finding.names[-1]
        if all(name.isdecimal() for name in names):
            values["order"] = order_in_words([int(name) for name in names])
    seconds, feedback = numbers.get("seconds", 0.0), bool(numbers.get("feedback"))
    for share in ("explained", *(f"explained_{axis}" for axis in "xyz")):
        values[f"{share}_percent"] = percent(max(numbers.get(share, 0.0), 0.0))
    values |= {"milliseconds": 1e3 * seconds, "twice": 2e3 * seconds}
    mixer = (
        "desaturates and a rate integrator that stops"
        if feedback
        else "clips each rotor by itself and a rate integrator that does not stop"
    )
    values |= {"mixer": mixer, "flag": str(feedback).lower()}
    seen = bool(numbers.get("seen"))
    frame = "that frame" if seen else "the centre of mass and the body's axes"
    values |= {"frame": frame, "seen_flag": str(seen).lower()}
    lower = "ended lower, and its result was kept" if numbers.get("changed") else "ended no lower"
    return values | {"second_search": f"CMA-ES then searched more widely and {lower}"}
