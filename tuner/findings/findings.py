"""Findings that qualify a result: codes with numbers, each with its sentence and remedy."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from tuner.core.phrases import CodeWithText, as_sentence, listed, percent, shorten
from tuner.findings import sentences
from tuner.vehicle.motor_orders import order_in_words

MAX_FINITE = 1e300
"""Replaces infinite numbers, which JSON lacks."""

Level = Literal["failure", "warning", "info"]
Text = str | Callable[[Any], str]
"""A text with the finding's numbers in braces, ``names``, ``first`` and ``last`` for its names in
words, ``coefficients`` and ``given`` for its raw names, ``subject`` for its subject; or a function
that returns the sentence."""

GIVE_VEHICLE = (
    "Give --vehicle and --mass; tune new-vehicle writes a starting file from mass, size and "
    "propellers."
)

NUMBER = re.compile(r"[-+]?[0-9.]*[0-9](?:e[-+]?[0-9]+)?")
MIN_TEXT_LETTERS = 55
"""A short line keeps so many letters of the sentence."""
CLAUSE_END = re.compile(r"[;.] | \(|, (?=and|as|at|or|if)|: (?!false|true)(?=[a-z0-9]+ )")
"""The end of a sentence's first clause; never before the value of a setting."""


class Code(CodeWithText):
    """Codes of findings; the comment after each lists its numbers and names."""

    RECORDING = (
        "recording",  # count and numbers, names: code, topic and names of the `Note`
        sentences.recording,
        "",
    )
    SALVAGED = (
        "salvaged",  # those of `tuner.recordings.notes.Damage`; names: its cause and subject
        sentences.salvaged,
        "Record the flight again if what was lost matters.",
    )
    LEFT_OUT = (
        "left_out",  # names: what the flight lacks, what to do
        sentences.left_out,
        lambda finding: as_sentence(finding.names[1]),
    )
    FLIGHT_WORSE = (
        "flight_worse",  # before, after; names: position or attitude, its unit
        (
            "Its {first} is met worse than before the fit: RMSE {after:.3g} {unit}, before "
            "{before:.3g} {unit}."
        ),
        "Look at its figures and at inspect: it may have been flown, or recorded, otherwise.",
    )
    FLIGHT_CRASHES = (
        "flight_crashes",  # seconds
        (
            "The simulated flight crashes after {seconds:.1f} s: with the initial coefficients it "
            "does not."
        ),
        "Do not use this fit: free other coefficients, and look at inspect.",
    )
    PART_FAILED = (
        "part_failed",  # names: the type of the error, its text
        (
            "This part failed and is left out: {given}, {text}. The rest of the result does not "
            "depend on it."
        ),
        "Please report it, with the job's log.",
    )
    MISSING_SIGNALS = (
        "missing_signals",  # names: the signals
        "It holds no {names}: the flight says less about the motors, and about inertia.",
        "Log that too, if you can.",
    )
    POSE_GAP = (
        "pose_gap",  # seconds
        "No pose was recorded for {seconds:.2f} s during the mission.",
        "Check the cameras' view and the network.",
    )
    SAME_RECORDING = (
        "same_recording",  # names: the other flight
        "It is the recording of {coefficients}: it counts twice, and held out it checks nothing.",
        "Leave one of them out.",
    )
    WRONG_VEHICLE = (
        "wrong_vehicle",  # lift, weight (N), mass (kg)
        (
            "This is not the vehicle that flew: turning as recorded, its rotors would lift "
            "{lift:.3g} N on average, and {mass:g} kg weigh {weight:.3g} N."
        ),
        GIVE_VEHICLE,
    )
    CANNOT_HOVER = (
        "cannot_hover",  # idle, full, weight (N), mass (kg)
        (
            "This is not the vehicle that flew: {mass:g} kg weigh {weight:.3g} N, and its rotors "
            "lift {idle:.3g} N idling, {full:.3g} N at full command."
        ),
        GIVE_VEHICLE,
    )
    ROTORS_STOP = (
        "rotors_stop",  # limit, allowed (rad/s)
        (
            "Rotors stop at {limit:.0f} rad/s whatever more is commanded, and the vehicle file "
            "has them stop at {allowed:.0f} rad/s: lags and torques make up for it."
        ),
        "Set motor.max_rotor_velocity to {limit:.0f} in the vehicle file.",
    )
    DSHOT_OR_PULSES = (
        "dshot_or_pulses",  # pulses, dshot (times the weight)
        (
            "Its commands were taken for pulses of PWM, which lift {pulses:.2g} times the weight; "
            "as DShot they would lift {dshot:.2g} times."
        ),
        "Give command its unit in the topic map: pwm_us or dshot.",
    )
    LIFTS_OTHERWISE = (
        "lifts_otherwise",  # more (share); names: the signal, battery?
        sentences.different_thrust,
        "Fit flights of one vehicle and payload, each kind by itself.",
    )
    SPARSE_INPUT = (
        "sparse_input",  # recorded, needed (Hz); names: the signal
        (
            "The {first} comes at {recorded:.0f} of {needed:.0f} Hz: what happened in between is "
            "lost, and moments of inertia may be wrong by tens of percent, more than their "
            "intervals show."
        ),
        "Log it at the full rate, or choose an inlet further upstream.",
    )
    INLET_CHOSEN = (
        "inlet_chosen",  # correlation, recorded, gyro (Hz); names: inlet, signal, order?
        sentences.inlet_chosen,
        lambda finding: (
            ""  # the motors' order, with its own finding, is the cause
            if len(finding.names) > 2
            else f"Log the {finding.names[1].replace('_', ' ')} as often as its loop runs."
        ),
    )
    MANOEUVRES_CHOSEN = (
        "manoeuvres_chosen",  # fitted, flights; names: recording, numbers
        (
            "It is long: {fitted:.0f} of its {flights:.0f} manoeuvres are fitted, those that show "
            "most (missions {others})."
        ),
        "Name others under 'missions' in its side-car, {first}.yaml.",
    )
    PX4_LOOPS = (
        "px4_loops",  # names: the inlet
        (
            "PX4's own position and attitude control flew it, other loops than the geometric ones "
            "that are simulated: it enters below them, through the inlet {first}."
        ),
        "",
    )
    LOGGED_GAINS = (
        "logged_gains",  # names: what the log has otherwise, each as a clause
        "The rate loop is simulated with the log's own parameters: {coefficients}.",
        "",
    )
    LOGS_DIFFER = (
        "logs_differ",  # names: the parameters
        (
            "Parameters differ between the logs, or change in one: {coefficients}; those with "
            "which the first log's vehicle was armed are simulated."
        ),
        "Fit logs one by one, each flown with one set of parameters.",
    )
    ATTITUDE_FOLLOWED = (
        "attitude_followed",  # names: the inlet that it could have entered through
        (
            "The recorded attitude of all fitted flights is followed, so that nothing is fitted of "
            "how the vehicle turns: that of this flight is followed, too."
        ),
        "",
    )
    MOTOR_ORDER = (
        "motor_order",  # names: the recorded columns, from 1, in the vehicle's order
        (
            "Motors are in another order: how they turn the vehicle makes them {names} of the "
            "columns that the topic map lists."
        ),
        "Write motor_order: {order} into the topic map.",
    )
    SPINS_REVERSED = (
        "spins_reversed",
        "Motors yaw it against the spins of the vehicle file.",
        "Check the spins, the motors' order, and the sign of the gyro's z.",
    )
    SETPOINTS_SCALED = (
        "setpoints_scaled",  # gain, correlation; names: the axis, the law guessed
        sentences.setpoints_scaled,
        lambda finding: (
            f"Set attitude.law: {finding.names[1]} in the controller file."
            if finding.names[1]
            else "Check thrust.normalized_constant and the gains of position control in the "
            "controller file."
            if finding.names[0] == "thrust"
            else "Check the gains of position and attitude control in the controller file."
        ),
    )
    SETPOINTS_LATE = (
        "setpoints_late",  # seconds
        (
            "The recorded rate set-points are those of the controller file to a state that is "
            "{milliseconds:.0f} ms old: a slow estimator, a filter or late stamps lie between."
        ),
        "Check the stamps of pose and set-points; the fit takes it for estimate_latency.",
    )
    SETPOINTS_BIASED = (
        "setpoints_biased",  # axis -> bias (rad/s)
        sentences.setpoints_biased,
        "Check how the motion capture's rigid body is aligned with the vehicle (marker_tilt).",
    )
    SETPOINTS_FOREIGN = (
        "setpoints_foreign",  # axis -> correlation
        sentences.setpoints_foreign,
        "Give the controller that flew (--controller), or enter below it (inlet: body_rate).",
    )
    HEADING_FLOWN = (
        "heading_flown",  # correlation
        (
            "The heading was commanded otherwise, as by hand: recorded yaw rate set-points do not "
            "follow from the controller file (correlation {correlation:.2f}), so that the "
            "reference says nothing of it."
        ),
        "Feed in its rate set-points (inlet: body_rate) if yaw matters.",
    )
    STILL_AXES = (
        "still_axes",  # names: the axes
        "No flight moves in {names}: inertia and rotor drag there are not excited.",
        "Fly a circle or a lemniscate.",
    )
    NO_YAW = (
        "no_yaw",  # rate (rad/s)
        (
            "No flight yaws faster than {rate:.2f} rad/s: inertia_zz and moment_constant are not "
            "excited."
        ),
        "Fly a yaw spin.",
    )
    IMPLAUSIBLE_BOUNDS = (
        "implausible_bounds",  # lower, upper, plausible_lower, plausible_upper
        (
            "The bounds {lower:g} to {upper:g} exclude every plausible value "
            "({plausible_lower:g} to {plausible_upper:g})."
        ),
        "Widen them.",
    )
    SETTINGS_UNUSED = (
        "settings_unused",  # the subject: the coefficients
        "The job file gives bounds, a scale or a prior, which have no effect: it is not fitted.",
        "Free it (--fit, or free: in the job file), or leave these settings out.",
    )
    START_ON_BOUND = (
        "start_on_bound",  # bound, start
        "The initial value {bound:g} is not inside its bounds; the search starts at {start:.3g}.",
        "",
    )
    NOT_FINITE = (
        "not_finite",
        "The simulation with the initial coefficients does not stay finite.",
        "Check the vehicle and controller files.",
    )
    NOTHING_HAS_EFFECT = (
        "nothing_has_effect",
        "No free coefficient has an effect on any recorded signal.",
        "Use flights that move, or other channels.",
    )
    NO_EFFECT = (
        "no_effect",
        "The coefficient has no effect on any recorded signal.",
        "Fix it with --fix {subject}, or record a signal that it acts on.",
    )
    SINGULAR_DIRECTION = (
        "singular_direction",  # names: the coefficients
        (
            "A common change of {coefficients} leaves every recorded signal as it is: the flights "
            "do not tell them apart."
        ),
        "Fix one of them to its measured value (--fix {given}).",
    )
    SATURATION_FEEDBACK = (
        "saturation_feedback",  # feedback: 1 if the integrator stops, else 0
        (
            "The flown mixer is not the file's: the recordings agree with one that {mixer} at the "
            "rotors' lower limit. The fit simulated that one."
        ),
        "Set mixer.saturation_feedback: {flag} (in the controller file).",
    )
    SEES_MARKERS = (
        "sees_markers",  # seen: 1 if position and attitude control see them, else 0
        (
            "Position and attitude control saw {frame}, as recordings show, and not what the "
            "controller file has them see. The fit simulates what they saw."
        ),
        "Set sensing.sees_markers: {seen_flag} in the controller file.",
    )
    CLOCK_OFFSET = (
        "clock_offset",  # seconds; names: the clock
        "The {first} clock is {milliseconds:+.2f} ms late, which the fit takes into account.",
        "",
    )
    TURNING_UNEXPLAINED = (
        "turning_unexplained",  # explained (share)
        (
            "Inputs explain {explained_percent} of the turning: that share of the change of body "
            "rate over half a second. Noise in them, and the loop's answer to disturbances, make "
            "their torque look weaker than it is: inertia and lags are those that predict best, "
            "and inertia may be several times too large, whatever its interval says."
        ),
        "Log inputs at the rate loop's rate, or measure the inertia on the ground (tune bench).",
    )
    TURNING_REGRESSED = (
        "turning_regressed",  # explained_AXIS (shares), gain_AXIS, seconds
        (
            "Not all turning is recorded: rotors and forces of the air explain "
            "{explained_x_percent}, {explained_y_percent} and {explained_z_percent} of the angular "
            "acceleration about forward, left and up. The rest is not recorded, and the loop's "
            "rotors answer it. Moments of inertia and other physical coefficients are those of a "
            "regression of accelerations that the answer does not bend. Torque gains, damping and "
            "steady torque are not physical, but what predicts up to {seconds:g} s ahead best."
        ),
        "Fly faster and less evenly, or measure the inertia on the ground (tune bench).",
    )
    TURNING_NOT_PREDICTED = (
        "turning_not_predicted",  # likewise, no seconds
        (
            "Most turning is not recorded: rotors and forces of the air explain "
            "{explained_x_percent}, {explained_y_percent} and {explained_z_percent} of the angular "
            "acceleration about forward, left and up, too little to predict roll and pitch 0.1 s "
            "ahead better than that they stay. Physical coefficients are those of a regression of "
            "accelerations."
        ),
        "Feed the attitude in (inlet: attitude), or log what the loop is told to do.",
    )
    HOLDING_BETTER = (
        "holding_better",  # soonest, seconds, QUANTITY, QUANTITY_held; names: QUANTITYs
        sentences.worse_than_hold,
        "Predict less far ahead, or with more recorded.",
    )
    DISTURBANCES_FOLLOWED = (
        "disturbances_followed",  # wind (m/s), gust, thrust (shares), gust_, thrust_seconds
        sentences.estimated_disturbances,
        "",
    )
    FLIGHT_NOT_FLOWN = (
        "flight_not_flown",  # rmse, others (m), seconds; beyond, beyond_recorded (shares)?
        sentences.flight_not_followed,
        lambda finding: (
            "Check position.max_feedback_acceleration in the controller file; at this speed a few "
            "percent of thrust decide: fly it slower, and judge the fit by the other flights."
            if "beyond" in finding.numbers
            else "Look at what changes there: wind, damage, a reference or a controller that is "
            "another."
        ),
    )
    LAW_LACKING = (
        "law_lacking",  # share; names: axis, what it goes with, coefficients it moves
        sentences.missing_law,
        sentences.missing_law_remedy,
    )
    CONTROLLER_ANSWERS = (
        "controller_answers",  # AXIS, AXIS_error; names: P, I or late, the AXES
        sentences.controller_gains_differ,
        lambda finding: (
            "Compare the controller file with the autopilot's parameters, and the vehicle file's "
            "arms with the vehicle's, as they are now."
            if finding.subject == sentences.CONTROLLER_FILE
            else "Leave it out, or fit it by itself with the gains that flew."
        ),
    )
    RATE_LOOP_DIFFERS = (
        "rate_loop_differs",  # SETTING, SETTING_error, SETTING_file; names: SETTINGs
        sentences.rate_loop_differs,
        sentences.rate_loop_remedy,
    )
    ROTOR_SPEEDS_LATE = (
        "rotor_speeds_late",  # seconds
        sentences.rotor_speeds_late,
        "Log them unfiltered, and stamped when they were measured.",
    )
    ROTOR_CHANGED = (
        "rotor_changed",  # seconds, rotor (from 1), loss (share); names: its place
        sentences.rotor_changed,
        "Look at its propeller, motor and mount before you fly again.",
    )
    ROTORS_UNEQUAL = (
        "rotors_unequal",  # rotor_1 to rotor_4: thrust over their mean
        (
            "Rotors would give {rotor_1:.2f}, {rotor_2:.2f}, {rotor_3:.2f} and {rotor_4:.2f} times "
            "their mean thrust at the same speed, more apart than rotors of a kind are. Where the "
            "vehicle file has them elsewhere than they sit, thrust, drag and inertia are wrong "
            "with it."
        ),
        "Measure where the rotors sit (rotors in the vehicle file), and look at the propellers.",
    )
    TERM_SHOWS = (
        "term_shows",  # NAME, NAME_error; OTHER; names: NAMEs; the subject is their group
        sentences.term_shows,
        lambda finding: sentences.TERM_SENTENCES[finding.subject][1],
    )
    INPUT_LATE = (
        "input_late",  # seconds
        (
            "What is fed into the simulation is stamped {milliseconds:+.2f} ms late against the "
            "recorded state, which the fit takes into account."
        ),
        "",
    )
    STAMPED_LATE = (
        "stamped_late",  # seconds; names: the signal
        (
            "The {first} is stamped {milliseconds:+.0f} ms late against the gyro: moved by that, "
            "it turns the vehicle as was recorded."
        ),
        "Stamp it when it is measured, or move its column, or leave it out (channels).",
    )
    GYRO_OFFSET = (
        "gyro_offset",  # rate (rad/s); names: the axis
        "The {first} reads {rate:+.4f} rad/s at rest, which the fit takes into account.",
        "",
    )
    FLIGHTS_DISAGREE = (
        "flights_disagree",  # difference, error (shares, else in a unit); names: coefficient, unit?
        sentences.flights_disagree,
        "Fit them by themselves: their vehicle, payload, propellers, battery or gains may differ.",
    )
    FLIGHT_UNMATCHED = (
        "flight_unmatched",  # channel -> multiple of the noise
        sentences.flight_unmatched,
        "Leave it out: its vehicle, payload, controller, clock or wind may be others.",
    )
    MODEL_UNMATCHED = (
        "model_unmatched",  # unmatched, flights, noise_multiple
        (
            "It lacks an effect: the residuals of {unmatched:.0f} of {flights:.0f} flights are "
            "about {noise_multiple:.0f} times the measurement noise."
        ),
        "Judge the fit by held-out flights, not by its intervals.",
    )
    FLIGHTS_REFUTE = (
        "flights_refute",
        (
            "It crashes on a fitted flight, or flies most of them otherwise than they were "
            "recorded: they say nothing of its coefficients, whose intervals are no narrower than "
            "before."
        ),
        "Check controller file, set-points, frames and clocks; leave out a flight that crashes.",
    )
    FINER_THAN_STEPS = (
        "finer_than_steps",  # seconds
        (
            "Latencies go with the simulator's step: another step moves them by {milliseconds:g} "
            "ms, which the 95 % intervals leave out."
        ),
        "Take them as known to ±{twice:g} ms, twice as much, in any simulator.",
    )
    REFERENCE_VOLTAGE = (
        "reference_voltage",  # volts
        (
            "They are those at {volts:.2f} V, the highest voltage of these flights without load: "
            "the vehicle file names no other."
        ),
        "Give battery.reference_voltage in the vehicle file for those at another voltage.",
    )
    POORLY_MET = (
        "poorly_met",  # noise_multiple; names: the channel
        (
            "Its {first} is {noise_multiple:.0f} times the noise off: intervals are widened "
            "accordingly."
        ),
        "Fit first, then examine the fitted vehicle.",
    )
    STARTS_DISAGREE = (
        "starts_disagree",  # starts, changed: 1 if CMA-ES ended lower, else 0
        "No two of {starts:.0f} starts ended in the same minimum; {second_search}.",
        "",
    )
    FLIGHTS_FAR_OFF = (
        "flights_far_off",  # far_off, flights, changed
        (
            "The simulation of {far_off:.0f} of {flights:.0f} flights stayed far from the "
            "recording; {second_search}."
        ),
        "",
    )
    GROUND_CONFLICT = (
        "ground_conflict",  # deviation (standard errors), ground, flights, mass (kg)?; names: unit
        sentences.ground_conflict,
        lambda finding: (
            "Weigh the vehicle again; else look for what is wrong with the rig, or the model."
            if "mass" in finding.numbers
            else "Find out which is wrong, the rig or the model."
        ),
    )
    SCALES_WITH_MASS = (
        "scales_with_mass",  # mass (kg); names: the coefficients
        (
            "Without a pose the flights show {coefficients} over the mass alone; they hold for "
            "{mass:g} kg, and go with it."
        ),
        "Weigh the vehicle (--mass): that, or one measured inertia, closes the scale.",
    )
    NO_TACHOMETER = (
        "no_tachometer",
        (
            "No rotor speed tells the curve from command to rotor speed, which stays the vehicle "
            "file's: motor_constant goes with the inverse square of input_scaling."
        ),
        "Set input_scaling by one tachometer reading; thrust and torque do not need it.",
    )
    YAW_OPEN = (
        "yaw_open",
        "The flights show moment_constant over inertia_zz, and not each of them.",
        "Measure one of the two: a bifilar pendulum gives inertia_zz (tune bench).",
    )
    RATE_WORSE = (
        "rate_worse",  # before, after, hold (rad/s), seconds
        (
            "Its body rate is predicted worse than before: {seconds:g} s ahead, from its commands "
            "alone, to {after:.3g} rad/s instead of {before:.3g} rad/s."
        ),
        "Fit it by itself: another build, battery or propeller turns the vehicle otherwise.",
    )
    RATE_PREDICTED = (
        "rate_foretold",  # before, after, hold (rad/s), seconds
        (
            "From its commands alone the fitted coefficients predict the body rate of this flight, "
            "which was held out, {seconds:g} s ahead to {after:.3g} rad/s; the initial ones do to "
            "{before:.3g} rad/s, and that it stays as it is would be right to {hold:.3g} rad/s."
        ),
        "",
    )
    RATE_NOT_PREDICTED = (
        "rate_not_foretold",  # before, after, hold (rad/s), seconds
        (
            "From {seconds:g} s ahead on its body rate is better taken to stay as it is "
            "({hold:.3g} rad/s off) than predicted from its commands ({after:.3g} rad/s, "
            "{before:.3g} with the initial coefficients): these answer disturbances "
            "that are not recorded, and an open loop adds them up."
        ),
        "Predict less far ahead, or simulate the loop that flew.",
    )
    VEHICLE_NOT_GIVEN = (
        "vehicle_not_given",  # mass (kg)
        (
            "No vehicle was given, so that its {mass:g} kg and arms were taken: moments of "
            "inertia, thrust and drag go with them, which no flight shows and no interval holds."
        ),
        GIVE_VEHICLE,
    )
    MASS_NOT_GIVEN = (
        "mass_not_given",  # mass (kg)
        (
            "Its {mass:g} kg are the shipped file's: moments of inertia, thrust and drag "
            "are in proportion to it, which no flight shows and no interval holds."
        ),
        "Give what it weighs at take-off with --mass.",
    )
    BENCH_CONFLICT = (
        "bench_conflict",  # deviation (standard errors); names: the coefficients
        (
            "It contradicts the other experiments: what it says of {coefficients} lies "
            "{deviation:+.1f} standard errors from theirs."
        ),
        "Check its geometry (levers, arms, wires), its units and its calibration.",
    )

    def at(self, level: Level, subject: str, /, *names: str, **numbers: float) -> Finding:
        """Return a finding of this code, with its names and numbers."""
        return Finding(self, level, subject, numbers, names)

    def warning(self, subject: str, /, *names: str, **numbers: float) -> Finding:
        """Return a finding that does not stop a run."""
        return self.at("warning", subject, *names, **numbers)

    def info(self, subject: str, /, *names: str, **numbers: float) -> Finding:
        """Return a finding that explains."""
        return self.at("info", subject, *names, **numbers)


@dataclass(frozen=True)
class Finding:
    """A remark that qualifies a result.

    Attributes
    ----------
    code
        Its kind.
    level
        ``failure`` stops a run unless forced, ``warning`` does not, ``info`` explains.
    subject
        The flight, coefficient or part concerned.
    numbers, names
        As `Code` lists them beside the code.
    """

    code: Code
    level: Level
    subject: str
    numbers: Mapping[str, int | float] = field(default_factory=dict)
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Replace infinite numbers."""
        if not all(math.isfinite(number) for number in self.numbers.values()):
            finite = {n: v if math.isfinite(v) else MAX_FINITE for n, v in self.numbers.items()}
            object.__setattr__(self, "numbers", finite)


def sentence(finding: Finding) -> str:
    """Return the sentence of a finding."""
    return _in_words(finding.code.text, finding)


def remedy(finding: Finding) -> str:
    """Return the remedy of a finding, as a sentence; empty without one."""
    return _in_words(finding.code.remedy, finding)


def one_line(finding: Finding) -> str:
    """Return a finding as one line of a terminal."""
    return f"{finding.level}: {finding.subject}: {sentence(finding)} {remedy(finding)}".rstrip()


def merge_alike(findings: Iterable[Finding]) -> list[Finding]:
    """Return findings, with those that differ only in subject and numbers merged into the first."""
    alike: dict[tuple[object, ...], list[Finding]] = {}
    for finding in findings:
        text = NUMBER.sub("", CLAUSE_END.split(sentence(finding))[0])
        alike.setdefault((finding.code, finding.level, text), []).append(finding)
    return [
        replace(same[0], subject=", ".join(dict.fromkeys(one.subject for one in same)))
        for same in alike.values()
    ]


def shorten_finding(finding: Finding, width: int) -> str:
    """Return subject, sentence and remedy of a finding in so many characters.

    A longer sentence is cut to no less than `MIN_TEXT_LETTERS` letters, then the remedy is.
    """
    whole = f"{finding.subject}: {sentence(finding)} {remedy(finding)}".rstrip()
    if len(whole) <= width:
        return whole
    first, *others = finding.subject.split(", ")
    subject = shorten(f"{first} and {len(others)} more" if others else first, 30)
    what, to_do = CLAUSE_END.split(sentence(finding))[0].removesuffix("."), remedy(finding)
    if len(f"{subject}: {what}. {to_do}") > width and to_do:
        to_do = f"{CLAUSE_END.split(to_do)[0].removesuffix('.')}."
    left = width - len(f"{subject}: . {to_do}")
    cut = shorten(what, max(left, MIN_TEXT_LETTERS))
    end = "" if cut.endswith("…") else "."
    return shorten(f"{subject}: {cut}{end} {to_do}".rstrip(), width)


def _in_words(text: Text, finding: Finding) -> str:
    return text.format(**_placeholders(finding)) if isinstance(text, str) else text(finding)


def _placeholders(finding: Finding) -> dict[str, object]:
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
    frame = "the markers' frame" if seen else "the centre of mass and the body's axes"
    values |= {"frame": frame, "seen_flag": str(seen).lower()}
    lower = "ended lower, and its result was kept" if numbers.get("changed") else "ended no lower"
    return values | {"second_search": f"CMA-ES then searched more widely and {lower}"}
