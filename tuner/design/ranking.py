"""Rank candidate flights, and signals to log, by their effect on the intervals of coefficients.

Every candidate inside an arena is simulated with the fitted coefficients and differentiated by
them, with the noise of the recorded flights in each channel; its information is added to theirs.
The D-optimal flight shrinks the volume of the confidence ellipsoid most, the A-optimal one the sum
of squared relative errors (Goodwin and Payne, "Dynamic System Identification: Experiment Design and
Data Analysis", 1977). A signal is simulated along the recorded flights, and added likewise; its
residuals are assumed to exceed noise as much as those of recorded signals.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import numpy as np
from numpy.typing import NDArray

from sim_jax.control.geometric import ReferencePoint
from sim_jax.geometry import Vec3
from sim_jax.inlet import ReferenceInlet
from sim_jax.state import hover, hover_speed
from sim_jax.trajectory import Shape, shapes
from tuner.config import InletName, TrajectorySettings
from tuner.core.errors import InputError
from tuner.core.numerics import Array, log_determinant, scaled_inverse, std_errors_of
from tuner.design.proposals import MAX_WORTHWHILE_SHARE, LogProposal, Proposal, Proposals
from tuner.objective.criterion import Criterion
from tuner.objective.information import information_at
from tuner.objective.inlets import INLETS, STEADY_TORQUE
from tuner.objective.normal_equations import Objective
from tuner.objective.segments import MeasuredChannel, Segments
from tuner.objective.trajectory import FlightReference, at_speed, published
from tuner.recordings.flight import Series
from tuner.search.job_flights import JobFlight
from tuner.search.problem import SPIN_CHANNELS, Job, job_of
from tuner.search.progress import Fit, plain_criterion
from tuner.uncertainty.covariance import PRIOR_WIDENING
from tuner.uncertainty.examination import Examination
from tuner.uncertainty.verdict import Verdict
from tuner.vehicle import COEFFICIENTS, VehicleFile
from tuner.vehicle.model import vehicle_of

CLEARANCE_M = 0.5
"""Distance of a reference from the walls."""
FLIGHT_HEIGHT_M = 1.0
"""Height of the publisher's shapes above the ground."""
SPEEDS = (1.5, 3.0, 4.5, 6.0)
"""Peak speeds of the reference, m/s."""
YAW_RATES = (1.0, 2.0, 4.0, 6.0)
"""Yaw rates of the spins, rad/s."""
MIN_RADIUS_M = 0.5
"""A smaller shape is not proposed."""
MAX_ACCELERATION = 9.0
"""m/s². A reference with more, some 45° of tilt, is not proposed."""
LANES = 8
"""Candidates simulated at a time, or as many as there are recorded flights."""
MAX_SAMPLE_RATE_HZ = 100.0
"""Candidates are compared at this rate; their weights represent more samples."""


@dataclass(frozen=True)
class Arena:
    """A box about the origin, from wall to wall along x and y and from the ground up; m."""

    x: float
    y: float
    z: float

    @staticmethod
    def of(numbers: Sequence[float]) -> Arena:
        """Return an arena from its three lengths.

        Raises
        ------
        InputError
            They are not three, or too small to fly in.
        """
        if len(numbers) != 3 or not np.isfinite(numbers).all():
            raise InputError("--arena", "needs three lengths in m", "write it as 8,6,3")
        arena = Arena(*numbers)
        smallest = 2 * CLEARANCE_M + 2 * MIN_RADIUS_M
        if min(arena.x, arena.y) < smallest or arena.z < FLIGHT_HEIGHT_M + CLEARANCE_M:
            raise InputError(
                "--arena",
                f"{arena.x:g} by {arena.y:g} by {arena.z:g} m is too small to fly in",
                f"give at least {smallest:g},{smallest:g},{FLIGHT_HEIGHT_M + CLEARANCE_M:g}",
            )
        return arena


def candidates(arena: Arena) -> dict[str, TrajectorySettings]:
    """Return name -> moving shapes in two sizes and several speeds, and yaw spins."""
    flights: dict[str, TrajectorySettings] = {}
    for shape in shapes().values():
        flights |= dict(_moving_candidates(shape, arena))
        for rate in YAW_RATES if shape.spins else ():
            settings = TrajectorySettings(name=shape.name, yaw_rate=rate)
            flights[f"{_noun(shape)} at {rate:g} rad/s"] = settings
    return flights


def _moving_candidates(
    shape: type[Shape], arena: Arena
) -> Iterator[tuple[str, TrajectorySettings]]:
    walls = zip((arena.x, arena.y), shape.extent, strict=True)
    widest = [(wall / 2 - CLEARANCE_M) / extent for wall, extent in walls if extent]
    for share in (1.0, 0.5) if widest and shape.peak_speed else ():
        radius = max(min(widest) * share, MIN_RADIUS_M)
        settings = TrajectorySettings(name=shape.name, radius=round(radius, 2))
        for speed in SPEEDS:
            if shape.peak_acceleration * speed**2 / radius <= MAX_ACCELERATION:
                name = f"{_noun(shape)} of {settings.radius:g} m radius at {speed:g} m/s"
                yield name, at_speed(settings, speed)


def _noun(shape: type[Shape]) -> str:
    return f"a {shape.name.replace('_', ' ')}"


def candidate_problem(
    objective: Objective, flights: Sequence[TrajectorySettings], *, seconds: float
) -> Objective:
    """Return the problem with candidates instead of recordings; their measured values are zero.

    Parameters
    ----------
    objective
        The problem of the recorded, whole, flights.
    """
    recorded, schedule = objective.segments, objective.schedule
    references = [
        published(flight, duration=seconds, control_rate=schedule.position_control_rate)
        for flight in flights
    ]
    starts: Vec3 = jax.tree.map(lambda *places: np.stack(places), *(r.start for r in references))
    spins = np.array([shapes()[flight.name].spins for flight in flights])
    count = len(flights)
    segments = Segments(
        inlet=_reference_inlet(references, recorded),
        start=jax.tree.map(
            lambda leaf: np.broadcast_to(np.asarray(leaf, float), (count,)),
            eqx.filter_jit(hover)(objective.model.vehicle, starts),
        ),
        measured={
            name: _candidate_channel(
                measured,
                silent=spins & (name not in SPIN_CHANNELS),
                seconds=seconds,
                recorded=seconds_recorded(objective),
            )
            for name, measured in recorded.measured.items()
        },
        flight=np.arange(count),
        resting=None if recorded.resting is None else np.ones(count, bool),
        log_voltage=_filled_like(recorded.log_voltage, count, np.nan),
        start_sd=_filled_like(recorded.start_sd, count, 0.0),
        free_rows=recorded.free_rows,
    )
    return replace(
        objective, segments=segments, samples=round(seconds * schedule.log_rate), multiplicity=None
    )


def _reference_inlet(references: Sequence[FlightReference], recorded: Segments) -> ReferenceInlet:
    """Return the references as lanes of one inlet, with their last points held."""
    assert isinstance(recorded.inlet, ReferenceInlet)
    inlets = [reference.inlet for reference in references]
    length = max(len(reference.lap) - 1 for reference in references)  # none acts at the end

    def beside(*rows: Array) -> Array:
        edges = [
            np.pad(np.asarray(row)[:length], (0, max(length - len(row), 0)), mode="edge")
            for row in rows
        ]
        return np.stack(edges, axis=-1)

    points: ReferencePoint = jax.tree.map(beside, *(inlet.points for inlet in inlets))
    held = recorded.inlet.level_held
    return ReferenceInlet(
        points,
        spins=np.stack([inlet.spins for inlet in inlets]),
        yaw_rate=np.stack([inlet.yaw_rate for inlet in inlets]),
        level_held=None if held is None else np.zeros(len(inlets), bool),
    )


def _filled_like(recorded: Any, count: int, value: float) -> Array | None:
    """Return rows (n, C) of one value if the recorded flights have rows (n, F); else None."""
    return None if recorded is None else np.full((*recorded.shape[:-1], count), value)


def seconds_recorded(objective: Objective) -> Array:
    """Return the recorded duration (F,) s of each segment."""
    ends = [np.asarray(m.time).max(axis=0) for m in objective.segments.measured.values()]
    return np.asarray(np.max(ends, axis=0))


def _candidate_channel(
    measured: MeasuredChannel, *, silent: NDArray[np.bool_], seconds: float, recorded: Array
) -> MeasuredChannel:
    """Return one channel of every candidate, with the best recorded rate and precision.

    Parameters
    ----------
    measured
        The channel of the recorded segments.
    silent
        (C,) flags of candidates for which it is not compared.
    seconds, recorded
        Duration of a candidate, and (F,) of each recorded segment, in s.
    """
    weight = np.asarray(measured.weight)
    rows = int(seconds * MAX_SAMPLE_RATE_HZ) - 1
    recorded_rate = (weight > 0).sum(axis=0) / np.maximum(recorded, 1e-9)
    equivalent = np.where(
        weight.max(axis=0) > 0,
        weight.max(axis=0) * np.sqrt(recorded_rate / MAX_SAMPLE_RATE_HZ),
        0.0,
    )
    segments = len(silent)
    time = np.repeat(np.arange(1, rows + 1)[:, None] / MAX_SAMPLE_RATE_HZ, segments, axis=1)
    values = np.zeros((rows, np.asarray(measured.values).shape[1], segments))
    if values.shape[1] > weight.shape[1]:
        values[:, 0] = 1.0  # an attitude
    constant = np.where(silent, 0.0, equivalent.max(axis=1)[:, None])
    weights = np.broadcast_to(constant, (rows, *constant.shape))
    return MeasuredChannel(
        time=np.asarray(time), values=np.asarray(values), weight=np.asarray(weights)
    )


def rank_next_flights(
    examination: Examination, criterion: Criterion, *, arena: Arena, seconds: float
) -> Proposals:
    """Rank candidate flights.

    Parameters
    ----------
    criterion
        Of the fit, with the weights of the recorded residuals.
    """
    full_problem, fitted = examination.full_problem, examination.uncertainty
    count, found = len(fitted.names), candidates(arena)
    names = tuple(examination.sensitivity.steps)
    verdicts = {name: fitted.estimates[name].verdict for name in fitted.names}
    verdicts |= {
        name: fixed_one.estimates[name].verdict for name, fixed_one in examination.of_fixed.items()
    }
    weak = [name for name in names if verdicts[name] is not Verdict.WELL_KNOWN]
    free = [name for name in weak if name in fitted.names]
    fixed = [
        name
        for name in weak
        if name in examination.of_fixed and COEFFICIENTS[name].informed_by != "weighing"
    ]
    targets = free or fixed or list(fitted.names)
    recorded, vector = full_problem.objective, full_problem.point.coefficients
    now = examination.information.data + examination.information.prior / PRIOR_WIDENING**2
    if free or not fixed:  # nothing is asked of those that were not fitted
        recorded, vector = replace(recorded, space=full_problem.fit_space), vector[:count]
        now = now[:count, :count]
    flights, at_once = [*found.values()], max(recorded.segments.count, LANES)
    kinds = (np.asarray(full_problem.point.offsets) != 0.0).any(axis=1)
    gains, flown = [], []
    for first in range(0, len(flights), at_once):
        some = flights[first : first + at_once]
        objective = candidate_problem(recorded, some, seconds=seconds)
        point = objective.start(vector)
        scales = {
            name: np.full(len(some), float(np.median(scale)))
            for name, scale in criterion.scale.items()
        }
        weights = plain_criterion(objective, objective.samples, scales)
        jacobian = objective.jacobian(point, weights)
        information = information_at(
            objective,
            point,
            weights,
            jacobian,
            offsets_fitted=np.repeat(kinds[:, None], len(some), axis=1),
        )
        inside = _stays_inside(objective, jacobian.residuals, arena)
        gains += list(information.blocks.sum(axis=(0, 2)))
        flown += list(~information.crashed & inside)
    rows = [
        Proposal(
            name=flight,
            trajectory=trajectory.model_dump(mode="json"),
            shrinks={name: _ratio(now, gain, names.index(name), count) for name in targets},
            volume=_volume(now, gain, count),
        )
        for (flight, trajectory), gain, flies in zip(found.items(), gains, flown, strict=True)
        if flies
    ]
    rows.sort(key=lambda row: (row.mean, row.name))
    return Proposals(
        arena=(arena.x, arena.y, arena.z),
        seconds=seconds,
        targets=targets,
        fixed_targets=[name for name in targets if name in examination.of_fixed],
        all_known=not free,
        flights=rows,
    )


def _ratio(now: Array, gain: Array, place: int, count: int) -> float:
    """Return an interval's width after a flight over that before, all fitted ones free too.

    Parameters
    ----------
    now, gain
        (N, N) information about all coefficients, of the recorded flights and of the candidate.
    place
        Of the coefficient in them.
    count
        How many of them, the first ones, are fitted.
    """
    places = [*range(count), *([place] if place >= count else [])]
    square = np.ix_(places, places)
    row = places.index(place)
    before, after = (scaled_inverse(matrix[square])[row, row] for matrix in (now, now + gain))
    return float(np.sqrt(after / before))


def _volume(now: Array, gain: Array, count: int) -> float:
    """Return the factor on the geometric mean of the half axes of the fitted ones' ellipsoid."""
    before, after = (log_determinant(matrix[:count, :count]) for matrix in (now, now + gain))
    return float(np.exp(-0.5 * (after - before) / count))


def _stays_inside(
    objective: Objective, residuals: dict[str, jax.Array], arena: Arena
) -> NDArray[np.bool_]:
    """Return (C,) whether the simulated vehicle stays between the walls, if positions are known."""
    if "position" not in residuals:
        return np.ones(objective.segments.count, bool)
    weight = np.asarray(objective.segments.measured["position"].weight)
    distance = np.abs(np.asarray(residuals["position"])) / np.where(weight > 0, weight, np.inf)
    half = np.array([arena.x / 2, arena.y / 2, arena.z])
    return np.asarray((distance.max(axis=0) <= half[:, None]).all(axis=0))


LOG_RATE_HZ = 100.0
"""The rate of a proposed signal."""
TACHOMETER_NOISE = 0.01
"""Noise of a measured rotor speed, as a share of that in hover."""
NOISE: Mapping[str, float] = {"command": 0.005, "body_rate": 0.02}
"""Noise of other signals that could be logged, in their units."""

RANDOM_WALK_GROWTH, SMOOTH_GROWTH = 2.0, 16.0
"""Growth of the variance lost between samples at twice their interval: of a random walk, and of a
smooth signal. With less growth coarse samples miss everything, and the least gain is assumed."""
MIN_VARIANCE_SHARE = 0.25
"""No rate is assumed to reduce the residuals' variance to a smaller share."""
INPUT_RATE_HZ = 250.0
"""Commands at this rate can be inputs: a rotor's lag is some samples long."""


def signals_to_add(
    fitted: Fit, known: Array, inlets: Sequence[InletName], vehicle: VehicleFile
) -> list[LogProposal]:
    """Return proposals of signals that are not compared yet.

    Parameters
    ----------
    fitted, known
        A fit, and the information (K, K) about its coefficients, priors included.
    """
    objective = fitted.objective
    silent = set.intersection(*(set(INLETS[inlet].not_compared) for inlet in inlets))
    fed = {name for inlet in inlets for name in INLETS[inlet].needs}
    noise = {"rotor_speed": TACHOMETER_NOISE * float(hover_speed(vehicle_of(vehicle))), **NOISE}
    missing = [n for n in noise if n not in objective.segments.measured and n not in silent | fed]
    before, proposals = std_errors_of(known), []
    for signal in missing:
        shares = std_errors_of(known + _information(fitted, signal, noise[signal])) / before
        shrinks = dict(zip(objective.space.names, shares.tolist(), strict=True))
        proposals.append(
            LogProposal(
                signal=signal,
                change="added",
                rate=LOG_RATE_HZ,
                noise=noise[signal],
                shrinks=shrinks,
            )
        )
    return proposals


def share_at_twice_the_rate(losses: Sequence[float]) -> float:
    """Return the share of its width that an interval keeps with an input logged twice as fast.

    The variance lost between samples is a power of their interval (Richardson's extrapolation).

    Parameters
    ----------
    losses
        Of the fit with all samples of the input, every second and every fourth.
    """
    lost, more = np.diff(losses)
    if lost <= 0.0:
        return 1.0
    growth = more / lost if RANDOM_WALK_GROWTH <= more / lost <= SMOOTH_GROWTH else SMOOTH_GROWTH
    return float(np.sqrt(max(1.0 - lost / growth / losses[0], MIN_VARIANCE_SHARE)))


def residual_to_noise(criterion: Criterion) -> float:
    """Return the median ratio of residuals to noise over the recorded channels."""
    return float(np.median(np.concatenate([np.asarray(s) for s in criterion.scale.values()])))


def _information(fitted: Fit, signal: str, noise: float) -> Array:
    """Return the information (K, K) of a signal at the fitted point, if it were logged."""
    objective, criterion = fitted.objective, fitted.criterion
    ends = seconds_recorded(objective)
    seconds = objective.samples / float(objective.schedule.log_rate)
    time = np.repeat(
        np.arange(1, max(int(seconds * LOG_RATE_HZ), 2))[:, None] / LOG_RATE_HZ, len(ends), axis=1
    )
    width = 3 if signal == "body_rate" else 4
    weight = np.repeat((time <= ends)[:, None] / noise, width, axis=1)
    measured = MeasuredChannel(
        time=np.asarray(time), values=np.zeros(weight.shape), weight=np.asarray(weight)
    )
    alone: Objective = eqx.tree_at(lambda o: o.segments.measured, objective, {signal: measured})
    scale = {signal: np.full(objective.flights, residual_to_noise(criterion))}
    plain = replace(criterion, scale=scale, huber=np.inf)
    information = information_at(alone, fitted.point, plain)
    return np.asarray(information.blocks.sum(axis=(0, 1, 2)))


def propose_logs(
    job: Job, fitted: Fit, known: NDArray[np.float64], vehicle: VehicleFile
) -> tuple[LogProposal, ...]:
    """Return proposals that would narrow some interval, the most helpful first.

    Parameters
    ----------
    known
        (K, K) information about the fitted coefficients, priors included.
    """
    found = signals_to_add(fitted, known, job.inlets, vehicle)
    for otherwise in (_faster_inputs, _fed_inputs):
        with suppress(InputError):  # too few samples for a simulation
            found += otherwise(job, fitted)
    useful = [
        proposal for proposal in found if min(proposal.shrinks.values()) < MAX_WORTHWHILE_SHARE
    ]
    return tuple(sorted(useful, key=lambda proposal: min(proposal.shrinks.values())))


def _faster_inputs(job: Job, fitted: Fit) -> list[LogProposal]:
    """Return the proposal of the input at twice its rate, if all flights have the same inlet.

    Its gain is extrapolated from fits with every second and every fourth sample.
    """
    segments, inlets = fitted.objective.segments, set(job.inlets)
    if len(inlets) > 1 or not segments.windowed or segments.start_sd is not None:
        return []
    signal = INLETS[inlets.pop()].needs[0]
    losses = [_loss(fitted, fitted.objective)]
    for every in (2, 4):
        rows = [_thin(r, signal, every) for r in job.recordings if not r.holdout]
        coarser = job_of(job.settings, rows).objective.segments
        if coarser.count != segments.count:
            return []
        thinned = eqx.tree_at(lambda o: o.segments, fitted.objective, coarser)
        losses.append(_loss(fitted, thinned))
    shrinks = dict.fromkeys(fitted.objective.space.names, share_at_twice_the_rate(losses))
    gaps = np.concatenate([np.diff(flight.series[signal].time) for flight in job.fitted])
    rate = 2.0 * float(1.0 / np.median(gaps))
    return [LogProposal(signal=signal, change="faster", rate=rate, shrinks=shrinks)]


def _loss(fitted: Fit, objective: Objective) -> float:
    sums = objective.sums(fitted.point, fitted.criterion, derivatives=False)
    return float(np.sum(np.asarray(sums.loss)))


def _thin(recording: JobFlight, signal: str, every: int) -> JobFlight:
    """Return a recording with one of `every` samples of a signal."""
    flight = recording.flight
    series = flight.series[signal]
    some = Series(series.time[::every], series.values[::every])
    return replace(recording, flight=replace(flight, series={**flight.series, signal: some}))


def _fed_inputs(job: Job, fitted: Fit) -> list[LogProposal]:
    """Return the proposal of commands as input, instead of the attitude.

    The logged commands represent faster ones, of similar torques.
    """
    commands = INLETS["actuator"]
    followed = set(job.inlets) == {"attitude"}
    if not followed or not all(commands.can_be_fed(flight) for flight in job.fitted):
        return []
    fed = job_of(
        job.settings, [replace(r, inlet="actuator") for r in job.recordings if not r.holdout]
    )
    turning = {name for name, row in COEFFICIENTS.items() if row.part == "turning"}
    names = [n for n in fed.space.names if n in turning and n not in STEADY_TORQUE]
    values = fed.space.numbers(fed.space.initial)
    best = job.space.numbers(fitted.point.coefficients)
    vector = fed.space.vector_of(values | {name: best[name] for name in best if name in values})
    objective = fed.objective
    beyond = residual_to_noise(fitted.criterion)
    scales = {name: np.full(objective.flights, beyond) for name in objective.segments.measured}
    criterion = plain_criterion(objective, objective.samples, scales)
    information = information_at(objective, objective.start(vector), criterion)
    shares = std_errors_of(information.total) / std_errors_of(information.prior)
    shrinks = {name: float(shares[fed.space.names.index(name)]) for name in names}
    return [
        LogProposal(signal="command", change="fed", rate=INPUT_RATE_HZ, shrinks=shrinks)
    ] * bool(names)
