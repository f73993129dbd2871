"""Coverage of intervals: simulation-based calibration on the plan of the reference flights.

Truths are drawn from a prior, and flown with measurement noise; depending on the kind of flight
with gusts, and with a random half of some terms beyond the motor model. Each set is fitted from the
prior's mean by all stages of the search, with that prior and with all of these terms in the model,
and the truth is ranked. So what is calibrated is the interval of a model that can fly what
flew: `benchmarks.lab` measures what selects terms. A search that says that it did not converge is
counted as such, not ranked: it says so to its user, too. ``TUNE_CALIBRATION_DRAWS`` sets of each
kind are drawn, in ``TUNE_CALIBRATION_WORKERS`` processes beside this one.

Source: Talts, Betancourt, Simpson, Vehtari, Gelman, "Validating Bayesian inference algorithms with
simulation-based calibration", 2018.
"""

from __future__ import annotations

import datetime
import os
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import jax.numpy as jnp
import numpy as np
from scipy.stats import binom, norm

from benchmarks.oracle import oracle_error, simulate_like
from benchmarks.table import ResultSection, figure
from benchmarks.timing import ROOT
from sim_jax.inlet import ReferenceInlet
from tuner.config import resolve_settings
from tuner.core.numerics import Array
from tuner.core.phrases import listed
from tuner.engine import Report, engine_for
from tuner.objective.criterion import picked
from tuner.objective.normal_equations import Objective
from tuner.objective.space import Space
from tuner.options import Options
from tuner.search.continuation import run_stages
from tuner.search.estimation import free_parameters
from tuner.search.job_flights import read_recordings
from tuner.search.problem import Job, job_of
from tuner.search.progress import Fit, criterion_of, initial_progress
from tuner.search.stages import plan
from tuner.terms.candidates import with_terms
from tuner.uncertainty.estimates import uncertainty_of
from tuner.uncertainty.records import CALIBRATION, COVERAGE_LEVELS, Calibration, CoverageRecord
from tuner.vehicle.model import with_terms_computed

DRAWS = int(os.environ.get("TUNE_CALIBRATION_DRAWS", "20"))
WORKERS = int(os.environ.get("TUNE_CALIBRATION_WORKERS", "0")) or None

FIRST_SEED = 20
"""Sets with smaller seeds served to choose the rules' parameters."""
PRIOR_SHARE = 0.25
"""The prior that truths are drawn from and fits are steadied by, over the usual one: with that,
half of the vehicles could not fly."""
TERMS = (
    "rotor_drag_ratio_y",
    "fuselage_drag",
    "thrust_inflow_coefficient",
    "rotor_inertia",
    "center_of_mass_x",
    "center_of_mass_y",
)
P_TERM = 0.5
"""Probability that a vehicle has a term."""
BOUND_MARGIN = 0.01
"""Share of its range by which a truth keeps away from a coefficient's bounds."""


@dataclass(frozen=True)
class Kind:
    """The disturbances of a kind of flights."""

    name: str
    gusts: bool
    terms: bool


KINDS = (
    Kind("noise alone", gusts=False, terms=False),
    Kind("gusts", gusts=True, terms=False),
    Kind("terms and gusts", gusts=True, terms=True),
)


@dataclass(frozen=True)
class RankedSet:
    """A set of flights, its truth ranked.

    Attributes
    ----------
    off
        Coefficient -> estimate minus truth, in quoted standard errors.
    error
        Coefficient -> the quoted standard error, of the scaled coordinate.
    oracle
        Coefficient -> what someone would quote who knows the truth and the gusts' law.
    """

    off: dict[str, float]
    error: dict[str, float]
    oracle: dict[str, float]
    seconds: float
    converged: bool


def measure() -> ResultSection:
    """Draw, fly, fit and rank every kind of flight; keep what is found for the report's page."""
    seeds = range(FIRST_SEED, FIRST_SEED + DRAWS)
    tasks = [(number, seed) for number in range(len(KINDS)) for seed in seeds]
    found: dict[str, list[RankedSet]] = {kind.name: [] for kind in KINDS}
    with engine_for(WORKERS) as engine:
        for (number, seed), ranked in zip(tasks, engine.stream(_task, tasks), strict=True):
            found[KINDS[number].name].append(ranked)
            print(_line(KINDS[number], seed, ranked), flush=True)
    kinds = tuple(_coverage(name, _converged(sets)) for name, sets in found.items())
    today = datetime.date.today().isoformat()
    text = Calibration(date=today, kinds=kinds).model_dump_json(indent=2)
    CALIBRATION.write_text(f"{text}\n", encoding="utf-8")
    return section(found, today)


def section(found: Mapping[str, Sequence[RankedSet]], date: str) -> ResultSection:
    """Return the table of what was found of each kind of flight."""
    rows = [row for name, sets in found.items() for row in _rows(name, _converged(sets))]
    left = [sum(not ranked.converged for ranked in sets) for sets in found.values()]
    draws = sorted({len(sets) for sets in found.values()})
    seconds = [ranked.seconds for sets in found.values() for ranked in sets]
    text = (
        f"Measured in simulation, {date}: {' to '.join(map(str, draws))} sets of flights of each "
        "kind, on the plan of the four fitted reference flights, at truths drawn from a prior "
        f"{figure(PRIOR_SHARE)} times as wide as the usual one, each of {len(TERMS)} terms there "
        "or not. Fitted from the prior's mean with what may have flown in the model. The share of "
        "intervals that hold the truth: of all coefficients with twice its standard error, by the "
        "scatter from set to set; of each, beside it the range in which the share of so many sets "
        "would lie 19 times of 20, were the intervals what they say. Estimate minus truth is in "
        "quoted standard errors: its root mean square is 1 where these are exact, less where they "
        f"are too large. {listed(tuple(map(str, left)))} searches say that they did not converge, "
        "and are not counted. An oracle knows the truth and the law of the gusts, flies the set "
        "again and again, and quotes how far linear fits to those flights scatter; beside it the "
        "median of how many times as large the quoted error is. "
        f"{np.mean(seconds):.0f} s of processor time a set."
    )
    head = ["flights", "coefficient", "sets", *(f"{level} %" for level in COVERAGE_LEVELS)]
    head += ["mean", "RMS", "of an oracle's"]
    return ResultSection("Calibration of the intervals", text, head, rows)


def _task(task: tuple[int, int], _: Report) -> RankedSet:
    return ranked_set(KINDS[task[0]], task[1])


def ranked_set(kind: Kind, seed: int) -> RankedSet:
    """Draw a truth, fly and fit it."""
    clock = time.process_time()
    random = np.random.default_rng([seed, KINDS.index(kind)])
    objective = problem(terms=kind.terms)
    flown = None
    while flown is None:
        truth = draw_truth(objective.space, random)
        flown = simulate_like(objective, truth, random, gusts=kind.gusts)
    found = fitted(flown)
    error = uncertainty_of(found).covariance.error
    space = objective.space
    true, best = (np.asarray(space.scaled(jnp.asarray(v))) for v in (truth, _vector(found)))
    off = dict(zip(space.names, ((best - true) / error).tolist(), strict=True))
    errors = dict(zip(space.names, error.tolist(), strict=True))
    oracle = oracle_error(
        found, truth, gusts=kind.gusts, random=np.random.default_rng([seed, KINDS.index(kind), 1])
    )
    return RankedSet(off, errors, oracle, time.process_time() - clock, found.converged)


@lru_cache(maxsize=1)
def reference_job() -> Job:
    """Return the reference flights' job: their plan, stamps and noise."""
    paths = [str(path) for path in sorted((ROOT / "reference_flights").glob("*.bag"))]
    settings = resolve_settings(
        Options(paths, config=str(ROOT / "reference_flights" / "tune.yaml"))
    )
    return job_of(settings, read_recordings(settings)[0])


@lru_cache(maxsize=2)
def problem(*, terms: bool, more: tuple[str, ...] = (), narrowed: float = PRIOR_SHARE) -> Objective:
    """Return the reference flights' problem with the prior of the truths.

    With terms, these are `TERMS` and ``more``. A spin is held level: nothing else holds a vehicle
    in gusts.
    """
    job = reference_job()
    objective = job.objective
    if terms:
        names = [*TERMS, *more]
        objective = replace(objective, model=with_terms_computed(objective.model, names))
        start = objective.start(objective.space.initial)
        objective, _ = with_terms(objective, start, names, job.settings.job)
    parameters = [replace(p, prior_sd=narrowed * p.prior_sd) for p in objective.space.parameters]
    inlet = objective.segments.inlet
    assert isinstance(inlet, ReferenceInlet), "the reference flights are flown in closed loop"
    held = replace(inlet, level_held=inlet.spins)
    return replace(
        objective,
        space=Space(parameters, objective.space.fixed),
        segments=replace(objective.segments, inlet=held),
    )


def draw_truth(space: Space, random: np.random.Generator) -> Array:
    """Return the search vector (K,) of a truth from the prior; a term is there or not.

    None is next to a bound, where an interval would be one-sided.
    """
    while True:
        there = np.array([n not in TERMS or random.random() < P_TERM for n in space.names])
        scaled = space.prior_mean + there * space.prior_sd * random.normal(size=len(space))
        share = (scaled - space.lower) / space.width
        if np.all((share > BOUND_MARGIN) & (share < 1.0 - BOUND_MARGIN)):
            return space.at_share(share)


def fitted(objective: Objective) -> Fit:
    """Return the fit that the search leads to from the prior's mean."""
    space, names = objective.space, [flight.name for flight in reference_job().fitted]
    rate = float(objective.schedule.log_rate)
    steps = reference_job().settings.job.search.max_iterations
    stages = plan("gradient", objective.samples, rate, windows=False, robust=True, steps=steps)
    begin = space.at_share((space.prior_mean - space.lower) / space.width)
    progress = run_stages(
        objective,
        stages,
        initial_progress(objective, begin[None]),
        free=free_parameters(reference_job()),
        undecided={},
        on_progress=lambda _: None,
    )
    point = picked(progress.points, 0)
    return Fit(
        objective=objective,
        point=point,
        criterion=criterion_of(stages[-1], progress.scales, np.asarray(point.offsets), None),
        noise={},
        scales={
            name: {channel: float(scale[i]) for channel, scale in progress.scales.items()}
            for i, name in enumerate(names)
        },
        iterations=(),
        outcomes=(),
        method="gradient",
        evaluations=progress.evaluations,
        wall_time=0.0,
        loss_best=float(progress.losses[0]),
        converged=progress.converged,
    )


def _vector(found: Fit) -> Array:
    return np.asarray(found.point.coefficients)


def share_within(off: Iterable[float], level: str) -> float:
    """Return the share of intervals of a level in per cent that hold the truth."""
    reach = norm.ppf(0.5 + float(level) / 200.0)
    return float(np.mean(np.abs(list(off)) <= reach))


def band(level: str, sets: int) -> tuple[float, float]:
    """Return the shares between which those of 95 % of so many sets would lie."""
    low, high = binom.ppf([0.025, 0.975], sets, float(level) / 100.0) / sets
    return float(low), float(high)


def scatter(sets: Sequence[RankedSet], level: str) -> float:
    """Return the standard error of the share of all coefficients, whose errors go together."""
    shares = [share_within(ranked.off.values(), level) for ranked in sets]
    return float(np.std(shares, ddof=1) / np.sqrt(len(shares))) if len(shares) > 1 else float("nan")


def _converged(sets: Sequence[RankedSet]) -> list[RankedSet]:
    return [ranked for ranked in sets if ranked.converged]


def _coverage(name: str, sets: Sequence[RankedSet]) -> CoverageRecord:
    shares = {c: share_within((r.off[c] for r in sets), "95") for c in sets[0].off}
    return CoverageRecord(
        flights=name,
        sets=len(sets),
        intervals=sum(len(ranked.off) for ranked in sets),
        coverage={level: _share_of_all(sets, level) for level in COVERAGE_LEVELS},
        least=min(shares.values()),
    )


def _share_of_all(sets: Sequence[RankedSet], level: str) -> float:
    return share_within([off for ranked in sets for off in ranked.off.values()], level)


def _rows(name: str, sets: Sequence[RankedSet]) -> list[list[str]]:
    """Return a kind's rows, all coefficients together first."""
    together = [
        f"{_percent(_share_of_all(sets, level))} ± {figure(200 * scatter(sets, level))} %"
        for level in COVERAGE_LEVELS
    ]
    moments = _moments(off for ranked in sets for off in ranked.off.values())
    rows = [[name, "all", str(len(sets)), *together, *moments, _ratio(sets, list(sets[0].off))]]
    for coefficient in sets[0].off:
        off = [ranked.off[coefficient] for ranked in sets]
        shares = []
        for level in COVERAGE_LEVELS:
            low, high = band(level, len(sets))
            shares.append(
                f"{_percent(share_within(off, level))} ({100 * low:.0f}–{100 * high:.0f})"
            )
        wider = _ratio(sets, [coefficient])
        rows.append([name, coefficient, str(len(sets)), *shares, *_moments(off), wider])
    return rows


def _ratio(sets: Sequence[RankedSet], names: Sequence[str]) -> str:
    """Return the median ratio of quoted errors to an oracle's."""
    times = [r.error[name] / r.oracle[name] for r in sets for name in names if name in r.oracle]
    return f"{figure(float(np.median(times)))} ×" if times else ""


def _moments(off: Iterable[float]) -> list[str]:
    values = np.array(list(off))
    return [f"{values.mean():+.2f}", figure(float(np.sqrt(np.mean(values**2))))]


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"


def _line(kind: Kind, seed: int, ranked: RankedSet) -> str:
    """Return a set in a line, as soon as it is there."""
    worst = sorted(ranked.off, key=lambda name: -abs(ranked.off[name]))[:4]
    off = ", ".join(f"{name} {ranked.off[name]:+.1f}" for name in worst)
    held = share_within(ranked.off.values(), "95")
    end = "" if ranked.converged else ", not converged"
    return f"{kind.name} {seed}: {_percent(held)} hold, {off}; {ranked.seconds:.0f} s{end}"
