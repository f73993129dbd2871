"""The usability of a fit, its uses and the reasons, for terminal, page and service."""

from __future__ import annotations

import math
import shlex
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from tuner.core.phrases import as_sentence, listed, listed_within, metres
from tuner.findings.findings import Code, Finding, remedy, sentence
from tuner.findings.sentences import CONTROLLER_FILE
from tuner.ground.measurement import BenchRecord, bench_in_words
from tuner.report.result_texts import simulator_lacks
from tuner.report.section import Cell, Table
from tuner.result import ExportRecord, FlightResult, RunResult
from tuner.uncertainty.records import Knowledge
from tuner.uncertainty.verdict import Verdict, verdict_in_words
from tuner.vehicle import COEFFICIENTS, scale_group

MAX_NAMES_LETTERS = 90
"""The names of flights in a sentence take at most so many letters."""
MAX_NOISE_RATIO = 1.5
"""A flight whose RMSE is at most so many times the noise is matched."""
MIN_UNCHANGED_RATIO = 0.8
"""An RMSE above this share of the initial one is unchanged."""
MAX_PRIOR_DEVIATIONS = 3.0
"""A coefficient so many prior standard deviations from a default vehicle's is another vehicle's."""
MAX_GAIN_RATIO = 1.2
"""Gains of the recorded rate loop further off than this factor are another loop's."""
ARM_SCALED: tuple[str, ...] = (
    *("inertia_xx", "inertia_yy", "inertia_zz", "moment_constant", "rotor_inertia"),
    *("flapping_moment_coefficient", "rolling_moment_coefficient"),
    *(f"{name}_{axis}" for name in ("center_of_mass", "torque_trim") for axis in "xyz"),
    *(f"angular_drag_{axis}" for axis in "xyz"),
)
"""Coefficients of which flights show the ratio to the arms only."""
Errors = tuple[float | None, float | None, float | None]
"""RMSE before and after a fit, and of the noise."""
WRONG_VEHICLE_CODES = frozenset(
    {
        Code.VEHICLE_NOT_GIVEN,
        Code.WRONG_VEHICLE,
        Code.CANNOT_HOVER,
        Code.MOTOR_ORDER,
        Code.SPINS_REVERSED,
        Code.SETPOINTS_FOREIGN,
        Code.SETPOINTS_SCALED,
    }
)
"""Warnings of vehicles and controllers other than the flown ones; simulations may fail."""
WRONG_INPUT_CODES = WRONG_VEHICLE_CODES | {
    Code.MASS_NOT_GIVEN,
    Code.SAME_RECORDING,
    Code.LIFTS_OTHERWISE,
    Code.DSHOT_OR_PULSES,
    Code.STAMPED_LATE,
    Code.ROTORS_STOP,
}
"""Warnings of inputs other than the flown ones: all numbers depend on them."""
CONFLICT_CODES = WRONG_INPUT_CODES | {
    Code.GROUND_CONFLICT,
    Code.BENCH_CONFLICT,
    Code.CONTROLLER_ANSWERS,
    Code.ROTORS_UNEQUAL,
}
"""Warnings of inputs or measurements that contradict the flights, to be resolved next."""
CAUSE_CODES = WRONG_INPUT_CODES | {
    Code.CONTROLLER_ANSWERS,
    Code.RATE_LOOP_DIFFERS,
    Code.TERM_SHOWS,
    Code.INLET_CHOSEN,
}
"""Warnings that cause others."""
DOUBT_CODES = CONFLICT_CODES | frozenset(
    {
        Code.MODEL_UNMATCHED,
        Code.FLIGHT_UNMATCHED,
        Code.FLIGHTS_DISAGREE,
        Code.FLIGHT_WORSE,
        Code.FLIGHT_NOT_FLOWN,
        Code.LAW_LACKING,
        Code.HOLDING_BETTER,
        Code.TURNING_UNEXPLAINED,
        Code.TURNING_REGRESSED,
        Code.TURNING_NOT_PREDICTED,
        Code.SPARSE_INPUT,
        Code.SINGULAR_DIRECTION,
        Code.FLIGHTS_FAR_OFF,
        Code.STARTS_DISAGREE,
        Code.RATE_WORSE,
    }
)
"""Warnings that cast doubt on the numbers."""


COEFFICIENT_OF = {
    "rate.roll.k": "rate_gain_roll_pitch",
    "rate.pitch.k": "rate_gain_roll_pitch",
    "rate.yaw.k": "rate_gain_yaw",
    "rate.roll.i": "integral_gain",
    "rate.pitch.i": "integral_gain",
    "rate.yaw.i": "integral_gain",
    "filters.gyro_cutoff": "gyro_cutoff_factor",
    "filters.dgyro_cutoff": "derivative_cutoff_factor",
}
"""Key of a rate loop in the controller file -> coefficient that stands for it."""


class Usability(StrEnum):
    """The usability of a fit."""

    USABLE = "usable"
    WITH_CARE = "usable with care"
    UNUSABLE = "not usable"


STYLE_OF = {Usability.USABLE: "well", Usability.WITH_CARE: "weak", Usability.UNUSABLE: "not"}


@dataclass(frozen=True)
class FlightOutcome:
    """The errors of a flight.

    Attributes
    ----------
    position, attitude
        RMSE before, after, and of the noise: distance in m, norm of the three angles in degrees;
        None for a crash or a signal that is not simulated.
    word
        ``matched`` (to the noise), ``better``, ``unchanged``, ``worse`` or ``crashes``.
    horizon
        s after which each simulation restarts at the recorded state; None if it never does.
    """

    name: str
    held_out: bool
    position: Errors
    attitude: Errors
    word: str
    horizon: float | None = None


@dataclass(frozen=True)
class FitOutcome:
    """The outcome of a fit.

    Attributes
    ----------
    what
        A sentence on the coefficients and flights of the fit.
    uses, reasons
        Sentences on its uses, and the reasons.
    flights
        Their errors, held-out ones first.
    checks
        Those that validate it: held-out ones, else all.
    """

    usability: Usability
    what: str
    uses: tuple[str, ...]
    reasons: tuple[str, ...]
    flights: tuple[FlightOutcome, ...]
    checks: tuple[FlightOutcome, ...]

    @property
    def look(self) -> str:
        """The CSS class on the page."""
        return STYLE_OF[self.usability]


def outcome(
    result: RunResult, bench: BenchRecord | None = None, exports: Sequence[ExportRecord] = ()
) -> FitOutcome:
    """Return the outcome of a fit; it is usable with care if no export passed."""
    flights = sorted(
        (_flight_outcome(flight, result) for flight in result.flights),
        key=lambda flight: not flight.held_out,
    )
    checks = [flight for flight in flights if flight.held_out] or flights
    usability = _usability(result, checks, flights)
    if usability is Usability.USABLE and _refusal(exports):
        usability = Usability.WITH_CARE
    return FitOutcome(
        usability,
        _fit_summary(result) if bench is None else bench_in_words(bench),
        _uses(result, usability),
        _reasons(result, checks),
        tuple(flights),
        tuple(checks),
    )


def sort_by_weight(findings: Sequence[Finding]) -> list[Finding]:
    """Return failures and warnings: causes of failure, causes, flights left out, doubts, others."""
    found = [finding for finding in findings if finding.level != "info"]
    refuted = any(finding.code is Code.FLIGHTS_REFUTE for finding in found)

    def weight(finding: Finding) -> tuple[bool, ...]:
        is_cause = finding.code in CAUSE_CODES
        is_doubt = is_cause or finding.code in DOUBT_CODES
        cause = refuted and finding.code in WRONG_VEHICLE_CODES
        left_out = finding.code is Code.LEFT_OUT
        return not cause, finding.level != "failure", not is_cause, not left_out, not is_doubt

    return sorted(found, key=weight)


def warnings_of(findings: Sequence[Finding]) -> list[Cell]:
    """Return failures and warnings as cells with their remedies."""
    found = sort_by_weight(findings)
    return [Cell(sentence(f), small=remedy(f), look=f.level, link=f.subject) for f in found]


def next_step(
    result: RunResult, found: FitOutcome, folder: Path, exports: Sequence[ExportRecord] = ()
) -> tuple[str, str]:
    """Return the next step after a fit: in words, and the command.

    Parameters
    ----------
    exports
        The requested ones; if all were refused, or the one that would be next, the reason comes
        first.
    """
    name = shlex.quote(str(folder))
    unusable = found.usability is Usability.UNUSABLE
    named = set(Code) - {Code.LEFT_OUT} if unusable else CONFLICT_CODES
    doubted = [finding for finding in sort_by_weight(result.findings) if finding.code in named]
    remedies = [words for finding in doubted if (words := remedy(finding))]
    if unusable or remedies:
        return remedies[0] if remedies else "Look at its flights.", f"tune report {name} --open"
    if found.flights and not any(flight.held_out for flight in found.flights):
        if len(found.flights) == 1:
            return "Record a second flight, and hold it out.", "tune ... --holdout FLIGHT"
        told = Counter(row.reason.flight for row in result.coefficients.values() if row.fitted)
        odd = {one.subject for one in result.findings if one.code is Code.FLIGHT_UNMATCHED}
        alike = [one for one in reversed(found.flights) if one.name not in odd] or found.flights
        flight = min(alike, key=lambda flight: told[flight.name]).name
        words = "Hold a flight out, which then checks the fit."
        return words, f"tune ... --holdout {shlex.quote(flight)}"
    if not found.flights:
        return "Fit flights from it.", f"tune --flights FLIGHT... --bench {name}"
    next_ones = [one for one in exports if one.format == "sdf"]
    if why := _refusal(exports) or _refusal(next_ones):
        return as_sentence(why), f"tune report {name} --open"
    return "Put it into your model.", f"tune export {name} --format sdf --into model.sdf"


def _refusal(exports: Sequence[ExportRecord]) -> str:
    """Return why all exports were refused; empty if one was written, or none requested."""
    refused = [one.refused for one in exports]
    return refused[0].partition(": ")[2].partition("; ")[0] if all(refused) and refused else ""


def examination_in_words(knowledge: Knowledge) -> str:
    """Return a sentence on the verdicts of an examination without a fit."""
    known = knowledge.coefficients.values()
    verdicts = [coefficient.verdict for coefficient in known if coefficient.fitted]
    flights = len(knowledge.flights)
    return (
        f"{len(verdicts)} coefficient{'s were' if len(verdicts) != 1 else ' was'} examined on "
        f"{flights} flight{'s' if flights != 1 else ''}, nothing fitted: "
        f"{verdict_counts(verdicts)}."
    )


def flights_table(flights: Sequence[FlightOutcome]) -> Table:
    """Return the table of flights' RMSE and noise."""
    looks = {"matched": "well", "better": "well", "unchanged": "weak"}
    rows: list[tuple[Cell | str, ...]] = [
        (
            flight.name + (", held out" if flight.held_out else ""),
            *_cells(flight.position, lambda value: f"{1e3 * value:.3g} mm"),
            *_cells(flight.attitude, lambda value: f"{value:.3g}°"),
            Cell(flight.word, look=looks.get(flight.word, "not")),
        )
        for flight in flights
    ]
    ahead = sorted({flight.horizon for flight in flights if flight.horizon is not None})
    ends = dict.fromkeys(f"{seconds:.2g}" for seconds in ahead[:: len(ahead) - 1 or 1])
    within = f" in {' to '.join(ends)} s" if ahead else ""
    columns = ("flight", f"position RMSE{within}", "noise", "attitude RMSE", "noise ", "verdict")
    return Table(columns, rows, words=("flight", "verdict"))


def verdict_counts(verdicts: Sequence[Verdict]) -> str:
    """Return a clause with the number of coefficients of each verdict."""
    counts = Counter(verdict_in_words(verdict) for verdict in verdicts)
    many = {one: one.replace("at its initial value", "at their initial values") for one in counts}
    clauses = [f"1 is {o}" if n == 1 else f"{n} are {many[o]}" for o, n in counts.items()]
    return f"all {clauses[0]}" if len(counts) == 1 and len(verdicts) > 1 else listed(clauses)


def _cells(errors: Errors, write: Callable[[float], str]) -> list[str]:
    before, after, noise = errors
    if before is None and after is None:
        return ["–", ""]
    both = " → ".join("crash" if value is None else write(value) for value in (before, after))
    return [both, "" if noise is None else write(noise)]


def _flight_outcome(flight: FlightResult, result: RunResult) -> FlightOutcome:
    position, attitude = (_errors(flight, result, signal) for signal in ("position", "attitude"))
    codes = {found.code for found in result.findings if found.subject == flight.name}
    word = _word(position, attitude, codes)
    held_out = flight.split == "holdout"
    return FlightOutcome(flight.name, held_out, position, attitude, word, flight.horizon)


def _word(position: Errors, attitude: Errors, codes: set[Code]) -> str:
    before, after, _ = position
    if after is None:
        return "crashes"
    if Code.FLIGHT_WORSE in codes:
        return "worse"
    pairs = [(end, noise) for _, end, noise in (position, attitude) if end is not None and noise]
    if pairs and all(end <= MAX_NOISE_RATIO * noise for end, noise in pairs):
        return "matched"
    return "better" if before is None or after < MIN_UNCHANGED_RATIO * before else "unchanged"


def _errors(flight: FlightResult, result: RunResult, signal: str) -> Errors:
    """Return a signal's RMSE before and after, and its noise as estimated by the fit."""
    noise = result.settings.get("noise")
    of_axis = noise.get(signal) if isinstance(noise, dict) else None
    unit = math.sqrt(3.0) * (math.degrees(1.0) if signal == "attitude" else 1.0)
    before, after = flight.rmse_initial.norm_or_none(signal), flight.rmse_best.norm_or_none(signal)
    return before, after, unit * of_axis if isinstance(of_axis, float) else None


def _usability(
    result: RunResult, checks: Sequence[FlightOutcome], flights: Sequence[FlightOutcome]
) -> Usability:
    words = {one.word for one in checks}
    if words & {"worse", "crashes"} or any(one.word == "crashes" for one in flights):
        return Usability.UNUSABLE
    codes = {found.code for found in result.findings}
    other_vehicle = codes & {Code.WRONG_VEHICLE, Code.VEHICLE_NOT_GIVEN}
    not_found = other_vehicle and codes & {Code.HOLDING_BETTER, Code.RATE_WORSE}
    if not_found or any(found.level == "failure" for found in result.findings):
        return Usability.UNUSABLE
    if _is_unfounded(result, flights) or _not_of_default_vehicle(result):
        return Usability.UNUSABLE
    if _is_of_another_loop(result):
        return Usability.UNUSABLE
    fitted = [row for row in result.coefficients.values() if row.fitted]
    unsure = (
        "unchanged" in words,
        bool(flights) and not any(one.held_out for one in flights),
        not result.search.converged,
        bool(fitted) and (all if flights else any)(row.identifiable is False for row in fitted),
        any(f.level == "warning" and f.code in DOUBT_CODES for f in result.findings),
    )
    return Usability.WITH_CARE if any(unsure) else Usability.USABLE


def _is_unfounded(result: RunResult, flights: Sequence[FlightOutcome]) -> bool:
    """Return whether flights determine nothing of the motor model, and none is predicted."""
    base = [
        row.identifiable
        for name, row in result.coefficients.items()
        if row.fitted and not COEFFICIENTS[name].is_effect
    ]
    unknown = bool(base) and all(identifiable is False for identifiable in base)
    return unknown and bool(flights) and not any(one.held_out for one in flights)


def _is_of_another_loop(result: RunResult) -> bool:
    """Return whether recorded commands are those of another rate loop than the fitted one.

    They are where they show a setting that no fitted coefficient stands for, or both another P and
    another I. A fit finds gains that differ from the file's alone; one that contradicts the
    commands of all its flights has put the error of a vehicle file, or of a controller file, into
    its coefficients.
    """
    fitted = {name for name, row in result.coefficients.items() if row.fitted}
    loops = [found for found in result.findings if found.code is Code.RATE_LOOP_DIFFERS]
    if any(COEFFICIENT_OF.get(name) not in fitted for found in loops for name in found.names):
        return True
    parts = {
        found.names[0]
        for found in result.findings
        if found.code is Code.CONTROLLER_ANSWERS
        and found.subject == CONTROLLER_FILE
        and any(
            not 1.0 / MAX_GAIN_RATIO <= found.numbers[axis] <= MAX_GAIN_RATIO
            for axis in found.names[1:]
            if found.names[0] != "late"
        )
    }
    return parts == {"P", "I"}


def _not_of_default_vehicle(result: RunResult) -> list[str]:
    """Return the coefficients that show that another vehicle flew than the default one.

    They are of those that go with the mass, which no flight shows.
    """
    if not any(found.code is Code.VEHICLE_NOT_GIVEN for found in result.findings):
        return []
    names = [name for name in scale_group() if COEFFICIENTS[name].scale == "log"]
    rows = {name: row for name in names if (row := result.coefficients.get(name))}
    return [
        name
        for name, row in rows.items()
        if row.fitted
        and abs(math.log(row.best / row.initial))
        > MAX_PRIOR_DEVIATIONS * COEFFICIENTS[name].prior_sd
    ]


def _fit_summary(result: RunResult) -> str:
    fitted, held = (
        sum(flight.split == split for flight in result.flights) for split in ("fit", "holdout")
    )
    free = sum(row.fitted for row in result.coefficients.values())
    text = f"{free} coefficient{'s were' if free != 1 else ' was'} fitted"
    if result.flights:
        job = result.settings.get("job")
        kind = "simulated flight" if isinstance(job, dict) and job.get("simulated") else "flight"
        text += f" to {fitted} {kind}{'s' if fitted != 1 else ''}"
        text += f"; {held} {'was' if held == 1 else 'were'} held out to check them" if held else ""
    return text + "."


def _uses(result: RunResult, usability: Usability) -> tuple[str, ...]:
    """Return sentences on the uses of a fit, and on excluded ones."""
    if usability is Usability.UNUSABLE:
        return ("Do not use these numbers: see the warnings for what to do first.",)
    sentences = []
    fitted = [flight.name for flight in result.flights if flight.split == "fit"]
    like = f"Simulating flights like the fitted ones ({listed_within(fitted, MAX_NAMES_LETTERS)})"
    if result.effective is not None:
        sentences.append(f"{like}: {simulator_lacks(result.effective)}")
    elif result.flights:
        sentences.append(f"{like}: Gazebo has every term of this model.")
    else:
        sentences.append("Starting a fit of flights that hold position and attitude.")
    by_verdict: dict[Verdict, list[str]] = {}
    for name, row in result.coefficients.items():
        if row.fitted:
            by_verdict.setdefault(row.verdict, []).append(name)
    known = by_verdict.pop(Verdict.WELL_KNOWN, [])
    if known and not by_verdict:
        sentences.append(f"Physical values: all {len(known)} coefficients are well known.")
    elif known:
        sentences.append(
            f"Physical values: {listed(known)} {'is' if len(known) == 1 else 'are'} well known."
        )
    for verdict, names in by_verdict.items():
        sentences.append(f"Not as physical values: {listed(names)}, {verdict_in_words(verdict)}.")
    mass = result.coefficients.get("mass")
    given = [("the vehicle file's arms, which no flight shows: measure them", ARM_SCALED)]
    if mass is not None and not mass.fitted:
        weighed = f"the mass, {mass.best:.4g} kg, which no flight shows: weigh it"
        given.insert(0, (weighed, scale_group()))
    for what, group in given:
        scaled = [name for name in known if name in group]
        if scaled and result.flights:
            sentences.append(f"{listed(scaled)} go{'es' if len(scaled) == 1 else ''} with {what}.")
    return tuple(sentences)


def _reasons(result: RunResult, checks: Sequence[FlightOutcome]) -> tuple[str, ...]:
    sentences = []
    for flight in checks[:3]:
        before, after, noise = flight.position
        what = "held out" if flight.held_out else "fitted"
        if after is None:
            sentences.append(f"{flight.name}, {what}, crashes in the simulation.")
            continue
        moved = f"{'a crash' if before is None else metres(before)} to {metres(after)}"
        moved += "" if flight.horizon is None else f" in predictions of {flight.horizon:.2g} s"
        floor = "" if noise is None else f"; the noise of its recording alone is {metres(noise)}"
        sentences.append(f"{flight.name}, {what}: position error from {moved}{floor}.")
    if result.flights and not any(flight.held_out for flight in checks):
        sentences.append("No flight was held out, so that nothing checks the fit: hold one out.")
    if _is_unfounded(result, checks):
        sentences.append("Its flights determine no coefficient of the motor model.")
    if others := _not_of_default_vehicle(result):
        sentences.append(
            f"Another vehicle than the default one flew: {listed(others)} ended far from its."
        )
    if _is_of_another_loop(result):
        sentences.append(
            "The recorded commands contradict the fitted rate loop: the vehicle file or the "
            "controller file is another's."
        )
    if not result.search.converged:
        sentences.append("The search stopped at its limit of iterations: resume it.")
    return tuple(sentences)
