"""Small fits with a term in the truth that the base model lacks, or without one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from sim_jax.geometry import Vec3
from sim_jax.inlet import BodyRateInlet
from tests.tuner.uncertainty.making import (
    FLIGHTS,
    NOISE,
    controller_file,
    fitted_of,
    problem,
    vehicle_file,
    with_data,
)
from tuner.config import JobFile
from tuner.objective.criterion import Point, units_of
from tuner.objective.normal_equations import Objective, with_conditions
from tuner.objective.simulation import SETPOINTS, fly
from tuner.objective.space import space_of
from tuner.recordings.flight import InitialState
from tuner.search.estimation import free_parameters, polished
from tuner.search.problem import Job
from tuner.search.progress import Fit

BASE = ("motor_constant", "rotor_drag_coefficient", "inertia_xx")


def job_with(drag: float, **given: Any) -> tuple[Job, Fit]:
    """Return the job of `unfitted_with` and its base fit."""
    job, start = unfitted_with(drag, **given)
    return job, _fit(job, start)


def unfitted_with(
    drag: float,
    *,
    seed: int,
    job: JobFile | None = None,
    tilt: tuple[float, float] = (0.0, 0.0),
    around: Mapping[str, Sequence[float]] | None = None,
    effects: Mapping[str, float] | None = None,
    setpoints: bool = False,
    base: tuple[str, ...] = BASE,
) -> tuple[Job, Fit]:
    """Return a job whose flights were flown with some drag of the body, and its start as a fit.

    Its recordings show a hover that is tilted, in rad about x and y; ``around`` is what surrounded
    each of them, and ``effects`` what flew instead of the drag; ``base`` is free from the
    beginning. With ``setpoints`` those of rate and thrust are fed in, as control without these
    effects asks for them.
    """
    there = {"fuselage_drag": drag} if effects is None else dict(effects)
    truth = problem((*base, *there))
    if setpoints:
        truth = fed_with_setpoints(truth)
    vector = truth.space.vector_of(
        dict(zip(truth.space.names, [p.initial for p in truth.space.parameters], strict=True))
        | there
    )
    names = tuple(around or ())
    flown, point = with_conditions(truth, truth.start(vector), names)
    rows = [around[name] / unit for name, unit in zip(names, units_of(names), strict=True)]
    offsets = jnp.asarray(np.vstack([np.zeros((len(truth.of_flight), len(FLIGHTS))), *rows]))
    flown = with_data(flown, Point(point.coefficients, offsets), noise=np.random.default_rng(seed))
    truth = replace(truth, segments=flown.segments)
    file = JobFile(free=base)
    space = space_of(vehicle_file(), controller_file(), file)
    objective = replace(truth, space=space)
    recordings = tuple(
        SimpleNamespace(
            flight=SimpleNamespace(
                name=name, initial=hovering(tilt), has=lambda _: False, series={}, notes=()
            ),
            holdout=False,
            inlet="body_rate" if setpoints else "reference",
            time_offset=0.0,
        )
        for name in FLIGHTS
    )
    settings = SimpleNamespace(
        job=job or JobFile(), vehicle=vehicle_file(), controller=controller_file()
    )
    made = Job(settings, recordings, NOISE, space, objective, settings)
    return made, fitted_of(objective, objective.start(space.initial))


def fed_with_setpoints(objective: Objective) -> Objective:
    """Return a problem whose flights enter by the set-points that its own control asks for."""
    segments = objective.segments
    flown = fly(
        objective.model,
        segments,
        objective.schedule,
        samples=objective.samples,
        limits=objective.limits,
        channels=(SETPOINTS,),
    )
    rows = jnp.asarray(np.moveaxis(flown.channels[SETPOINTS], 0, -1))
    inlet = BodyRateInlet(Vec3(rows[:, 0], rows[:, 1], rows[:, 2]), rows[:, 3])
    return replace(objective, segments=replace(segments, inlet=inlet))


def hovering(tilt: tuple[float, float], heading: float = 0.4) -> InitialState:
    """Return the start of a hover at a heading, tilted in rad about x and y."""
    attitude = Rotation.from_euler("z", heading) * Rotation.from_rotvec([*tilt, 0.0])
    rest = np.zeros(3)
    return InitialState(
        rest, rest, attitude.as_quat(scalar_first=True), rest, np.full(4, 600.0), np.full(4, 0.5)
    )


def _fit(job: Job, fitted: Fit) -> Fit:
    free = free_parameters(job)
    end = polished(job, fitted, free=free, title="base", on_progress=lambda _: None)
    return replace(end, outcomes=())
