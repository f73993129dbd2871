"""The command `tune sensitivity` as a function: what recordings tell of the coefficients."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim_jax.inlet import ReferenceInlet
from tuner.config import Options, Settings, check_names, initial_values, settle
from tuner.design.candidates import CLEARANCE, LEVEL, SMALLEST, Arena
from tuner.design.next_flight_json import Proposals, write_proposals
from tuner.design.ranking import Habits, rank_next_flights
from tuner.disk import make_folder
from tuner.errors import InputError
from tuner.examination.examination import Examination, examine
from tuner.examination.knowledge import knowledge_of
from tuner.examination.sensitivity_json import Knowledge
from tuner.examination.tables import write_files
from tuner.findings import Code, Finding
from tuner.flights.flight import Flight
from tuner.job.findings import UNMATCHED, saturation_feedback
from tuner.job.prepare import SPIN_CHANNELS, Job, job_of
from tuner.job.results import comparison_of, versions
from tuner.objective.criterion import Criterion, Point
from tuner.objective.normal import Objective
from tuner.recordings import read_recordings
from tuner.report import render
from tuner.report.record import About, Recording, write_about
from tuner.report.traces import write_simulated
from tuner.search.continuation import FEEDBACK_GAIN
from tuner.search.fitted import Fitted
from tuner.search.progress import beginning, criterion_of, with_feedback
from tuner.search.stages import WHOLE, schedule_of
from tuner.sensitivity.global_indices import global_sensitivity
from tuner.sensitivity.global_sensitivity_json import Method, write_global
from tuner.uncertainty.profile_likelihood import profile_likelihood
from tuner.uncertainty.profiles_json import write_profiles

ROOM = 1.0
"""m added to what the recorded flights took, to make an arena of it."""
SHORTEST = 20.0
"""s: the publisher takes ten to wind up. Flights are proposed of this length, or twice, four times
as long, whichever is nearest to the recorded ones: each length is compiled anew."""


@dataclass(frozen=True)
class SensitivityResult:
    """An examination's folder and what is in it."""

    folder: Path
    knowledge: Knowledge
    proposals: Proposals | None
    findings: tuple[Finding, ...]


@dataclass(frozen=True)
class SensitivityRequest:
    """What is to be told beside the local sensitivity.

    Attributes
    ----------
    arena
        m along x, y and up; None takes what the recorded flights took, and some more.
    whole_range
        Whose indices between the bounds to tell too; None tells none.
    samples
        How many for them; None for the usual number.
    span
        Share by which coefficients are varied for them, where the job file gives no bounds.
    profiles
        Coefficients whose likelihood to profile.
    """

    arena: Sequence[float] | None = None
    whole_range: Method | None = None
    samples: int | None = None
    span: float = 0.3
    profiles: Sequence[str] = ()


def examine_vehicle(
    options: Options,
    request: SensitivityRequest,
    *,
    out: Path,
    command: str = "",
    say: Callable[[str], None] = lambda _: None,
) -> SensitivityResult:
    """Tell what recordings say about the coefficients of a vehicle, nothing fitted.

    Parameters
    ----------
    options
        Flights, vehicle and everything else that decides the simulation; held-out flights are
        examined like the others.
    request
        What else is asked for.
    out
        The folder to write into.
    command
        What the user typed, for the record.
    say
        Is told what is being done.

    Raises
    ------
    InputError
        The input cannot be used; nothing was written.
    """
    settings = settle(options, fits=False)
    if request.arena is not None:
        Arena.of(request.arena)
    check_names(request.profiles, "--profile")
    if not 0 < request.span <= 10:
        raise InputError("--span", f"{100 * request.span:g} % is no span", "give 30 for ±30 %")
    if request.samples is not None and request.samples < 2:
        raise InputError("--samples", f"{request.samples} tell nothing", "give at least 2")
    job = job_of(settings, read_recordings(settings, holdout=()))
    make_folder(out)
    fitted = as_it_is(job)
    say("simulating, and differentiating by every coefficient")
    examination = examine(fitted)
    say("simulating what could be flown next")
    knowledge, proposals = write_examination(out, job, examination, fitted, arena=request.arena)
    _on_request(request, job, fitted, examination, folder=out, say=say)
    write_simulated(out, comparison_of(job, fitted).fly(settings.vehicle))
    write_about(out, _about(settings, job, fitted, command))
    render(out)
    return SensitivityResult(out, knowledge, proposals, fitted.findings)


def _on_request(
    request: SensitivityRequest,
    job: Job,
    fitted: Fitted,
    examination: Examination,
    *,
    folder: Path,
    say: Callable[[str], None],
) -> None:
    """Write what takes longer."""
    if request.whole_range is not None:
        say(f"flying vehicles between the bounds for {request.whole_range.capitalize()}'s indices")
        found = global_sensitivity(
            fitted.objective,
            fitted.point,
            fitted.criterion,
            method=request.whole_range,
            flights=[flight.name for flight in job.fitted],
            bounds=range_of(job, examination, request.span),
            samples=request.samples,
            seed=job.settings.job.search.seed,
        )
        write_global(found, folder)
    profiles = []
    for name in request.profiles:
        say(f"fitting the others again for each value of {name}")
        profiles.append(profile_likelihood(examination, fitted.criterion, name))
    if profiles:
        write_profiles(profiles, folder)


def range_of(job: Job, examination: Examination, span: float) -> dict[str, tuple[float, float]]:
    """Return where each fitted coefficient is varied: the job file's bounds, else some percent.

    The search's own bounds are guards: most vehicles between them cannot fly.
    """
    sensitivity = examination.sensitivity
    steps = dict(zip(sensitivity.names, sensitivity.step, strict=True))
    found = {}
    for parameter in job.space.parameters:
        own = job.settings.job.coefficients.get(parameter.name)
        value = examination.uncertainty.estimates[parameter.name].value
        if parameter.scale == "log":
            low, high = value / (1.0 + span), value * (1.0 + span)
        else:
            low, high = (value + side * span * float(steps[parameter.name]) for side in (-1, 1))
        said = (None, None) if own is None else (own.lower, own.upper)
        low = max(low, parameter.lower) if said[0] is None else said[0]
        high = min(high, parameter.upper) if said[1] is None else said[1]
        found[parameter.name] = (low, high)
    return found


def write_examination(
    folder: Path,
    job: Job,
    examination: Examination,
    fitted: Fitted,
    *,
    arena: Sequence[float] | None = None,
    once_known: Callable[[], None] = lambda: None,
) -> tuple[Knowledge, Proposals | None]:
    """Write what is known, and what to fly next in an arena, into a result folder.

    ``once_known`` is called in between, for the second takes its time.
    """
    knowledge = knowledge_of(examination, job.space, fitted.point)
    write_files(knowledge, folder)
    once_known()
    proposals = propose(job, examination, fitted.criterion, arena)
    if proposals is not None:
        write_proposals(proposals, folder)
    return knowledge, proposals


def as_it_is(job: Job) -> Fitted:
    """Return the vehicle that a job would start from as if a search had found it.

    Where rotors were clipped low, whether the rate integrator then stops is tried both ways.
    """
    space, said = job.space, job.settings.controller.mixer.saturation_feedback
    start = initial_values(job.settings.vehicle, job.settings.controller, space.free)
    vector = space.vector_of(start)
    tried = {
        feedback: _met(with_feedback(job.objective, float(feedback)), vector)
        for feedback in ((said, not said) if job.clipped else (said,))
    }
    best = min(tried, key=lambda feedback: tried[feedback].loss)
    if tried[said].loss <= FEEDBACK_GAIN * tried[best].loss:
        best = said
    met = tried[best]
    names = [flight.name for flight in job.fitted]
    return Fitted(
        objective=met.objective,
        point=met.point,
        criterion=met.criterion,
        noise=job.noise,
        scales={
            name: {channel: float(one[i]) for channel, one in met.scale.items()}
            for i, name in enumerate(names)
        },
        iterations=(),
        outcomes=(),
        method="none",
        evaluations=len(tried),
        wall_time=0.0,
        loss_initial=met.loss,
        loss_best=met.loss,
        converged=True,
        findings=tuple(_findings(met.scale, names, feedback=None if best == said else best)),
    )


@dataclass(frozen=True)
class _Met:
    """How closely a simulation meets the recordings: the problem, weighed accordingly."""

    objective: Objective
    point: Point
    criterion: Criterion
    scale: dict[str, NDArray[np.float64]]
    loss: float


def _met(objective: Objective, vector: NDArray[np.float64]) -> _Met:
    """Return a problem whose noise is scaled to the residuals where these are larger."""
    rate = float(objective.schedule.log_rate)
    (*_, whole) = (
        stage
        for stage in schedule_of(objective.samples, rate, robust=False, steps=1)
        if stage.name == WHOLE
    )
    fresh, point = beginning(objective, vector[None]), objective.start(vector)
    offsets = np.asarray(point.offsets)
    sums = objective.sums(
        point, criterion_of(whole, fresh.scales, offsets, fresh.states), derivatives=False
    )
    flight = np.asarray(objective.segments.flight)
    scale = {}
    for name, squares in sums.squares.items():
        total = np.bincount(flight, np.asarray(squares), minlength=objective.flights)
        count = np.bincount(flight, np.asarray(sums.counts[name]), minlength=objective.flights)
        scale[name] = np.maximum(np.sqrt(total / np.maximum(count, 1.0)), 1.0)
    criterion = criterion_of(whole, scale, offsets, fresh.states)
    return _Met(objective, point, criterion, scale, float(np.sum(np.asarray(sums.loss))))


def _findings(
    scale: Mapping[str, NDArray[np.float64]], names: Sequence[str], *, feedback: bool | None
) -> Iterator[Finding]:
    if feedback is not None:
        yield saturation_feedback("info", float(feedback))
    for index, name in enumerate(names):
        worst = max(scale, key=lambda channel: scale[channel][index])
        multiple = float(scale[worst][index])
        if multiple > UNMATCHED:
            yield Finding(Code.POORLY_MET, "warning", name, {"noise_multiple": multiple}, (worst,))


def propose(
    job: Job, examination: Examination, criterion: Criterion, said: Sequence[float] | None = None
) -> Proposals | None:
    """Return what to fly next; None where the controllers that flew are not simulated."""
    if not isinstance(examination.full_problem.objective.segments.inlet, ReferenceInlet):
        return None
    arena = arena_of(job.flights) if said is None else Arena.of(said)
    seconds = float(np.median([flight.duration for flight in job.fitted]))
    doublings = max(round(float(np.log2(seconds / SHORTEST))), 0)
    habits = Habits(SPIN_CHANNELS, round(SHORTEST * 2**doublings))
    return rank_next_flights(examination, criterion, arena=arena, habits=habits)


def arena_of(flights: Sequence[Flight]) -> Arena:
    """Return the room about the origin that some flights took, and a little more."""
    places = np.concatenate([flight.series["position"].values for flight in flights])
    x, y = (2.0 * float(np.nanmax(np.abs(places[:, axis]))) for axis in (0, 1))
    top = float(np.nanmax(places[:, 2]))
    least = 2.0 * CLEARANCE + 2.0 * SMALLEST
    return Arena(
        x=round(max(x + ROOM, least), 1),
        y=round(max(y + ROOM, least), 1),
        z=round(max(top + ROOM, LEVEL + CLEARANCE), 1),
    )


def _about(settings: Settings, job: Job, fitted: Fitted, command: str) -> About:
    return About(
        command=command,
        vehicle=settings.vehicle.name,
        versions=versions(),
        settings={
            "vehicle": settings.vehicle.model_dump(mode="json"),
            "controller": settings.controller.model_dump(mode="json"),
            "job": settings.job.model_dump(mode="json"),
            "origin": dict(settings.origin),
            "noise": dict(fitted.noise),
            "scales": {name: dict(scale) for name, scale in fitted.scales.items()},
        },
        findings=list(fitted.findings),
        flights=[
            Recording(name=f.name, path=str(f.path), sha256=f.sha256, duration=f.duration)
            for f in job.flights
        ],
    )
