"""How true fits of simulated lab flights are: bias and coverage of each coefficient, terms found.

``TUNE_LAB_SEEDS`` names the seeds, ``0,1,2`` by default: a fit takes some minutes. With
``TUNE_LAB_WORKERS`` so many processes take a seed each. Two laboratories of three have an effect
that a fit may not know (`benchmarks.lab_flights`); ``TUNE_LAB_EFFECT`` names it for all, ``none``
the right model, ``several`` two or three effects, and both have sections of their own.
``TUNE_LAB_KEPT`` names a file that keeps each laboratory as soon as it is fitted, and from which
the next run with the same effect goes on.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import numpy as np
from pydantic import BaseModel, ConfigDict

from benchmarks.lab_flights import (
    CHOICE,
    KNOWN,
    METER,
    RATE,
    SECONDS,
    TRAJECTORIES,
    VOLTS,
    Lab,
    drawn,
    effect_of,
    write,
)
from benchmarks.oracle import oracle_error
from benchmarks.table import ResultSection, figure, table
from sim_jax.schedule import Schedule
from tuner.config import resolve_settings
from tuner.core.numerics import Array
from tuner.core.phrases import listed
from tuner.engine import Report, engine_for
from tuner.findings.findings import Code, Finding, one_line
from tuner.job.prepare import prepare
from tuner.objective.battery import VOLTAGE, log_voltage_of
from tuner.objective.windows import Window
from tuner.options import Options
from tuner.recordings.flight import Flight
from tuner.search.listener import Reporter
from tuner.search.problem import Job
from tuner.search.progress import Fit
from tuner.terms.candidates import SelectionResult
from tuner.terms.refit_with_disturbances import refit_and_examine
from tuner.terms.selection import search_with_terms
from tuner.uncertainty.agreement import flights_disagree
from tuner.uncertainty.estimates import Estimate, Uncertainty, term_findings
from tuner.uncertainty.model_error import model_error_findings
from tuner.vehicle import COEFFICIENTS, values_of

SEEDS = tuple(int(seed) for seed in os.environ.get("TUNE_LAB_SEEDS", "0,1,2").split(","))
CONFIDENT = 3.0
"""Quoted errors beyond which a number is wrong that was said to be known."""
WORKERS = int(os.environ.get("TUNE_LAB_WORKERS", "0")) or None
KEPT = os.environ.get("TUNE_LAB_KEPT")


@dataclass(frozen=True)
class Trial:
    """A laboratory and what a fit made of its flights.

    Attributes
    ----------
    estimates
        Coefficient -> estimate, of those that are free and not held.
    oracle
        Coefficient -> what an oracle would quote, in the estimate's standard errors.
    voltage
        V at which the fit's motors were taken to run, if it has a battery.
    findings
        On the vehicle and its flights, as of a run.
    """

    lab: Lab
    found: tuple[str, ...]
    estimates: Mapping[str, Estimate]
    oracle: Mapping[str, float]
    seconds: float
    voltage: float | None = None
    findings: tuple[Finding, ...] = ()

    def true(self, name: str) -> float:
        """Return the true value of a coefficient, at the voltage of the fit."""
        known, neutral = values_of(self.lab.vehicle), COEFFICIENTS[name].neutral
        value = known.get(name, 0.0 if neutral is None else neutral)
        if self.voltage is None or name not in ("input_scaling", "zero_position_armed"):
            return value
        return float(value * (self.voltage / VOLTS) ** known.get("battery_exponent", 0.0))


class TrialRecord(BaseModel):
    """A trial in a line of a file."""

    model_config = ConfigDict(ser_json_inf_nan="constants")

    seed: int
    effect: str
    trial: Trial


def measure() -> ResultSection:
    """Fly, fit and compare every seed."""
    file = None if KEPT is None else Path(KEPT)
    had = {} if file is None else read_trials(file, CHOICE)
    trials = {seed: had[seed] for seed in SEEDS if seed in had}
    for seed, trial in trials.items():
        print(_line(seed, trial), flush=True)
    rest = [seed for seed in SEEDS if seed not in trials]
    with engine_for(WORKERS) as engine:
        for seed, trial in zip(rest, engine.stream(_task, rest), strict=True):
            trials[seed] = trial
            print(_line(seed, trial), flush=True)
            if file is not None:
                append_trial(file, TrialRecord(seed=seed, effect=CHOICE, trial=trial))
    return section([trials[seed] for seed in SEEDS])


def append_trial(file: Path, one: TrialRecord) -> None:
    """Append a trial to a file."""
    with file.open("a", encoding="utf-8") as lines:
        lines.write(one.model_dump_json() + "\n")


def read_trials(file: Path, effect: str) -> dict[int, Trial]:
    """Return seed -> trial of those that a file keeps for an effect; none if there is no file."""
    lines = file.read_bytes().splitlines() if file.exists() else []
    every = [TrialRecord.model_validate_json(line) for line in lines]
    return {one.seed: one.trial for one in every if one.effect == effect}


def section(trials: Sequence[Trial]) -> ResultSection:
    """Return the page's section about some trials."""
    missed = [group for trial in trials for group in trial.lab.groups if group not in trial.found]
    false = [group for trial in trials for group in trial.found if group not in trial.lab.groups]
    flown = sum(len(trial.lab.groups) for trial in trials)
    gusts = sum(trial.lab.gusts for trial in trials)
    text = (
        f"{len(trials)} laboratories ({gusts} with gusts), each with a vehicle, effects and set-up "
        "of its own, three flights of 18 s fitted from the original coefficients with the mass "
        f"given. Of {flown} groups of terms that were flown {flown - len(missed)} are found"
        f"{_named('; missed', missed)}; {len(false)} are found that were not flown"
        f"{_named('', false)}. Errors are shares of the truth, or, of what may be zero, of the "
        "coefficient's usual size; the interval's half-width likewise, its median over the fits, "
        "and the part of it that is largest in most of them. "
        "An oracle knows the truth and the laws of the gusts and of the voltmeter: it flies the "
        "fit's model at the truth again, in other gusts, with other noise and other readings, and "
        "quotes how far linear fits to those flights scatter; beside it the median of how many "
        "times as wide the quoted interval is. It knows nothing of terms that a fit lacks, or has "
        f"in vain. {_held_of_all(trials)}"
        f"{np.mean([trial.seconds for trial in trials]):.0f} s of processor time a fit."
    )
    several = any(trial.lab.effect.several for trial in trials)
    effects = any(trial.lab.effect.name for trial in trials)
    if effects:
        have = "All have two or three effects" if several else "Two of three have an effect"
        text += (
            f" {have} beside these terms, some of which no coefficient describes:\n\n"
            f"{_by_effect(trials)}\n\nAnd by coefficient:"
        )
    head = [
        "coefficient",
        "fits",
        "mean error",
        "RMS error",
        "95 % interval ±",
        "most of it",
        "of an oracle's",
        "hold the truth",
    ]
    title = "Simulated lab flights"
    if effects:
        title += " with several effects" if several else " with effects"
    return ResultSection(title, text, head, list(_rows(trials)))


def _held_of_all(trials: Sequence[Trial]) -> str:
    """Return how many intervals hold the truth, and would if they were narrower."""
    sentences = []
    for air, gusts in (("still air", False), ("gusts", True)):
        having = [trial for trial in trials if trial.lab.gusts is gusts]
        intervals = [(trial, name) for trial in having for name in trial.estimates]
        if not intervals:
            continue
        held = sum(_holds(*of) for of in intervals)
        known = [(trial, name) for trial, name in intervals if name in trial.oracle]
        twice = sum(_holds(trial, name, 2.0 * trial.oracle[name]) for trial, name in known)
        without = sum(
            _holds(trial, name, _share_without_terms(trial, name)) for trial, name in intervals
        )
        sentences.append(
            f"In {air} {held} of {len(intervals)} 95 % intervals hold the truth; without the part "
            f"`terms` {without} would, and {twice} of {len(known)} that are twice the oracle's. "
        )
    return "".join(sentences)


def _by_effect(trials: Sequence[Trial]) -> str:
    """Return the table of what became of laboratories with each effect, and without any."""
    rows = []
    effects = [{effect.name for effect in trial.lab.effect.each} for trial in trials]
    for name in sorted(set[str]().union(*effects)):
        having = [trial for trial, names in zip(trials, effects, strict=True) if name in names]
        off = [
            (_deviation(trial, coefficient), coefficient)
            for trial in having
            for coefficient in trial.estimates
        ]
        errors, worst = max(off, key=lambda one: abs(one[0]))
        inside = sum(_holds(trial, key) for trial in having for key in trial.estimates)
        far = [coefficient for by, coefficient in off if abs(by) > CONFIDENT]
        warnings = Counter(word for trial in having for word in _warnings(trial))
        rows.append(
            [
                name.replace("_", " ") or "none",
                "a term" if name in KNOWN else "",
                str(len(having)),
                str(sum(name in trial.found for trial in having)) if name in KNOWN else "",
                f"{inside} of {len(off)}",
                f"{len(far)}{_named('', far)}",
                f"{worst} {errors:+.1f}",
                ", ".join(f"{word} {n} ×" for word, n in warnings.most_common()),
            ]
        )
    head = ["effect", "in the registry", "laboratories", "found", "intervals hold"]
    head += [f"beyond {CONFIDENT:g} quoted errors", "worst, in quoted errors", "warnings"]
    return table(head, rows)


def _warnings(trial: Trial) -> set[str]:
    """Return the warnings of a trial: codes, of terms their group."""
    return {
        finding.subject if finding.code is Code.TERM_SHOWS else str(finding.code)
        for finding in trial.findings
        if finding.level == "warning"
    }


def _deviation(trial: Trial, name: str) -> float:
    """Return how far an estimate is off, in quoted standard errors."""
    estimate = trial.estimates[name]
    return (estimate.value - trial.true(name)) / max(estimate.std_error, 1e-300)


def _task(seed: int, report: Report) -> Trial:
    """Return the trial of a seed, as a task of an engine.

    Its programs are given up: a process may map only so many pieces of memory, and three
    laboratories take two thirds of them.
    """
    del report
    trial = trial_of(seed)
    jax.clear_caches()
    return trial


def job_at(lab: Lab, folder: Path, *, seed: int) -> tuple[Job, tuple[Finding, ...]]:
    """Fly a laboratory; return the job of fitting its flights, and its findings."""
    paths = write(lab, folder, seed=seed)
    return prepare(
        resolve_settings(Options([str(path) for path in paths], config=str(folder / "tune.yaml")))
    )


def searched(job: Job, folder: Path) -> SelectionResult:
    """Return the fit of a job, with the terms that its flights call for."""
    return search_with_terms(job, folder, resume=False, reporter=Reporter())


def trial_of(seed: int) -> Trial:
    """Fly and fit the laboratory of a seed."""
    effect = effect_of(seed, seconds=SECONDS, flights=len(TRAJECTORIES) - 1, log_rate=RATE)
    lab = drawn(seed, effect)
    with tempfile.TemporaryDirectory() as name:
        job, findings = job_at(lab, Path(name), seed=seed)
        clock = time.process_time()
        selected = searched(job, Path(name))
        reporter = Reporter()
        selected, examination = refit_and_examine(selected, reporter)
        fitted = selected.fitted
        seconds = time.process_time() - clock
    if examination is None:
        raise RuntimeError(one_line(reporter.findings[-1]))
    free = {
        name: estimate
        for name, estimate in examination.uncertainty.estimates.items()
        if name not in fitted.held
    }
    found = tuple(row.group for row in selected.rows if row.kept)
    reference = selected.job.settings.vehicle.battery.reference_voltage
    findings = (
        *findings,
        *fitted.findings,
        *reporter.findings,
        *model_error_findings(examination.model_errors, examination.uncertainty),
        *flights_disagree(fitted, examination),
        *term_findings(fitted, examination.uncertainty, selected.substitutes),
    )
    trial = Trial(lab, found, free, {}, seconds, reference, findings)
    volts = _voltages(selected.job.fitted, fitted.objective.schedule)
    return replace(trial, oracle=_oracle(trial, fitted, examination.uncertainty, volts, seed))


def _voltages(
    flights: Sequence[Flight], schedule: Schedule
) -> Callable[[np.random.Generator], Array | None]:
    """Return what draws the voltage that other readings of the meter would have passed for."""
    whole = [Window(flight, 0.0) for flight in flights]
    known = log_voltage_of(flights, whole, schedule)

    def drawn_voltage(random: np.random.Generator) -> Array | None:
        if known is None:
            return None
        with_readings_redrawn = []
        for flight in flights:
            readings = flight.series[VOLTAGE]
            noise = METER * random.normal(size=readings.values.shape)
            other = replace(readings, values=readings.values + noise)
            with_readings_redrawn.append(replace(flight, series={**flight.series, VOLTAGE: other}))
        return np.asarray(log_voltage_of(with_readings_redrawn, whole, schedule))

    return drawn_voltage


def _oracle(
    trial: Trial,
    fitted: Fit,
    quoted: Uncertainty,
    volts: Callable[[np.random.Generator], Array | None],
    seed: int,
) -> dict[str, float]:
    """Return coefficient -> what an oracle would quote, in quoted standard errors.

    The oracle's vehicle has the terms that were found; those that it lacks do not scatter.
    """
    space = fitted.objective.space
    truth = space.vector_of(
        {parameter.name: trial.true(parameter.name) for parameter in space.parameters}
    )
    random = np.random.default_rng([seed, 2])
    gusts = trial.lab.gusts
    errors = oracle_error(fitted, truth, gusts=gusts, random=random, log_voltage=volts)
    own = dict(zip(quoted.names, quoted.covariance.error, strict=True))
    return {name: error / own[name] for name, error in errors.items() if name in trial.estimates}


def _line(seed: int, trial: Trial) -> str:
    """Return a trial in a line, as soon as it is there."""
    errors = {name: _error(trial, name) for name in trial.estimates}
    inside = [name for name in errors if _holds(trial, name)]
    flown, found = set(trial.lab.groups), set(trial.found)
    worst = sorted(errors, key=lambda name: -abs(errors[name]))[:6]
    beside = [word for word, there in (("gusts", trial.lab.gusts),) if there]
    beside += [trial.lab.effect.name] if trial.lab.effect.name else []
    off = [f"{n} {100 * errors[n]:+.1f} % ({_deviation(trial, n):+.1f})" for n in worst]
    return (
        f"seed {seed}{f' with {listed(beside)}' if beside else ''}: {trial.seconds:.0f} s, missed "
        f"{sorted(flown - found)}, false {sorted(found - flown)}, {len(inside)} of {len(errors)} "
        f"intervals hold; {', '.join(off)}; warnings {sorted(_warnings(trial))}"
    )


def _rows(trials: Sequence[Trial]) -> list[list[str]]:
    names = [name for name in COEFFICIENTS if any(name in trial.estimates for trial in trials)]
    rows = []
    for name in names:
        having = [trial for trial in trials if name in trial.estimates]
        errors = np.array([_error(trial, name) for trial in having])
        half = np.median([_half_width(trial, name) for trial in having])
        wider = [1.0 / trial.oracle[name] for trial in having if name in trial.oracle]
        held = sum(_holds(trial, name) for trial in having)
        rows.append(
            [
                name,
                str(len(having)),
                f"{100 * errors.mean():+.2f} %",
                f"{figure(100 * np.sqrt(np.mean(errors**2)))} %",
                f"{figure(100 * half)} %",
                Counter(_cause(trial, name) for trial in having).most_common(1)[0][0],
                f"{figure(np.median(wider))} ×" if wider else "",
                f"{held} of {len(having)}",
            ]
        )
    return rows


def _size(trial: Trial, name: str) -> float:
    """Return what errors of a coefficient are compared with."""
    row, true = COEFFICIENTS[name], trial.true(name)
    return max(abs(true), row.prior_sd) if row.scale == "linear" else abs(true)


def _error(trial: Trial, name: str) -> float:
    return (trial.estimates[name].value - trial.true(name)) / _size(trial, name)


def _half_width(trial: Trial, name: str) -> float:
    low, high = trial.estimates[name].ci95
    return 0.5 * (high - low) / _size(trial, name)


def _cause(trial: Trial, name: str) -> str:
    """Return the largest part of a coefficient's quoted error."""
    parts = trial.estimates[name].parts.model_dump()
    return max(parts, key=lambda part: parts[part] or 0.0).replace("_", " ")


def _holds(trial: Trial, name: str, width: float = 1.0) -> bool:
    """Return whether an interval holds the truth that is so many times as wide as the quoted."""
    estimate, true = trial.estimates[name], trial.true(name)
    low, high = (estimate.value + width * (end - estimate.value) for end in estimate.ci95)
    return low <= true <= high


def _share_without_terms(trial: Trial, name: str) -> float:
    """Return the share of a quoted error that is left without its part `terms`."""
    parts = trial.estimates[name].parts
    on_top = sum((part or 0.0) ** 2 for part in (parts.step, parts.search, parts.lack))
    others = max(parts.noise or 0.0, parts.residuals or 0.0, parts.left_out or 0.0) ** 2 + on_top
    return float(np.sqrt(others / (others + (parts.terms or 0.0) ** 2)))


def _named(what: str, groups: Sequence[str]) -> str:
    times = {name: f" {n} ×" if n > 1 else "" for name, n in Counter(groups).items()}
    named = ", ".join(f"{name}{times[name]}" for name in sorted(times))
    return f"{what} ({named})" if groups else ""
