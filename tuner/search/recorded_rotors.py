"""Recorded rotor signals beside the motion: their lag, and a rotor that changes within a flight.

The loop responds to a disturbance with the rotors: their speeds correlate with the turning that
they oppose, later. In spectra that looks like a lag, the larger the slower. So a lag found from
spectra is accepted only if the innovations of the same regression confirm it: the part of each
acceleration that earlier ones do not predict, which holds no response
(`tuner.equation_error.regression`).

The motion of a rigid body determines force and moment, and four rotors produce them in one way. So
each rotor's share of the squared speeds is a function of the motion (angular acceleration, velocity
through the air, body rate, heading for a steady wind), whatever the disturbances and the loop's
response. Where a propeller breaks or a motor weakens, that rotor's share rises from one sample to
the next and stays there, and those of the others fall equally.

For each flight the shares are regressed on the motion, in windows of `WINDOW_S`, with a step at
each time in turn. Residuals are autocorrelated, as gusts are: a first-order autoregression is
estimated with the likeliest step, and steps are tested by generalised least squares. The statistic
is the largest over all times (Andrews, "Tests for parameter instability and structural change with
unknown change point", Econometrica 61, 1993).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sim_jax.constants import GRAVITY
from tuner.core.numerics import Array, finite_rows
from tuner.equation_error.recorded_accelerations import Mask, steps_with, with_rotors
from tuner.equation_error.regression import convolved, whitening_filter
from tuner.findings.findings import Code, Finding
from tuner.objective.inlets import INLETS, linear_interpolation
from tuner.objective.rotor_signals import Source, squared_speed
from tuner.recordings.flight import Flight, Series
from tuner.recordings.states import local_parabolas, states_at
from tuner.search.job_flights import JobFlight, regressors
from tuner.vehicle import VehicleFile

BAND_HZ = (0.7, 8.0)
"""Frequencies at which accelerations are compared."""
MEMORY_S = 0.1
"""Errors from which the next one is predicted."""
LAGS_S = np.arange(-24, 25) * 0.0025
"""Lags that are tried: five samples at 100 Hz, and as much again for a rotor's lag."""
MAX_LAG_SD_S = 0.003
SIGNIFICANT_SD = 2.81
"""Standard deviations from zero of a significant lag: one flight of 200 has that by chance."""
TRIMMED_SAMPLES = 10
"""Samples at either end of a flight that are left out: their derivatives are worse."""
WHITENING_ROUNDS = 3
"""Rounds of regression and whitening filter (Cochrane and Orcutt)."""
CORRELATED_FREQUENCIES = 3.0
"""Mean number of correlated neighbouring frequencies, by the taper and the filter."""

Spectrum = NDArray[np.complex128]


@dataclass(frozen=True)
class InputLag:
    """A lag and its standard deviation, in s."""

    seconds: float
    sd: float


def with_input_lags(recordings: Sequence[JobFlight], vehicle: VehicleFile) -> tuple[JobFlight, ...]:
    """Return recordings with the lags of their inputs, where they can be estimated.

    Rotor speeds have the lag itself, if it is significant and no response of the loop. Commands
    have their flight's lag less the flights' mean, which is the vehicle's own. Flights without an
    estimate, and held-out ones, have the mean of the others.
    """
    late: dict[str, float] = {}
    for inlet in {recording.inlet for recording in recordings}:
        same = [recording for recording in recordings if recording.inlet == inlet]
        if not INLETS[inlet].starts_recorded:
            continue
        is_measured = "actuator_latency" in INLETS[inlet].bypasses
        signal: Source = "rotor_speed" if is_measured else "command"
        lags = [
            (recording.flight, lag)
            for recording in same
            if not recording.holdout
            and recording.time_offset is None
            and (lag := input_lag(recording.flight, signal, vehicle)) is not None
        ]
        if not lags:
            continue
        accepted = {
            flight.name: lag.seconds if not is_measured or _is_late(flight, vehicle, lag) else 0.0
            for flight, lag in lags
        }
        mean = float(np.mean(list(accepted.values())))
        own = 0.0 if is_measured else mean
        late |= {r.flight.name: accepted.get(r.flight.name, mean) - own for r in same}
    return tuple(
        replace(r, input_late=late.get(r.flight.name, r.input_late)) if r.time_offset is None else r
        for r in recordings
    )


def _is_late(flight: Flight, vehicle: VehicleFile, lag: InputLag) -> bool:
    """Return whether a lag of rotor speeds is significant, and confirmed by innovations.

    Rotors respond within a step, too: a lag is not confirmed where none or half of it is as likely.
    """
    if abs(lag.seconds) <= SIGNIFICANT_SD * lag.sd:
        return False
    late, *others = _turning_likelihoods(flight, vehicle, (lag.seconds, 0.5 * lag.seconds, 0.0))
    return late - max(others) > 0.5 * SIGNIFICANT_SD**2


def _turning_likelihoods(flight: Flight, vehicle: VehicleFile, at: Sequence[float]) -> list[float]:
    """Return the log-likelihood of the innovations of angular accelerations at some lags in s.

    Forces are left out: the velocity that they come from is filtered.
    """
    rotors = flight.series["rotor_speed"]
    there = finite_rows(rotors.values)
    rotors = Series(rotors.time[there], rotors.values[there])
    steps = steps_with(flight, rotors)
    if steps is None:
        return [0.0] * len(at)
    parts = [with_rotors(steps, Series(rotors.time - late, rotors.values)) for late in at]
    complete = np.all([part.known for part in parts], axis=0)
    order = max(1, round(MEMORY_S / steps.step))
    new = [
        [
            _innovation_variance(steps.accelerations[:, 3 + axis], columns, complete, order)
            for axis, columns in enumerate(regressors(part, vehicle))
        ]
        for part in parts
    ]
    return [-0.5 * float(complete.sum() * np.log(of_axes).sum()) for of_axes in new]


def _innovation_variance(answer: Array, columns: Array, complete: Mask, order: int) -> float:
    """Return the mean square of the innovations of a regression's errors."""
    rows = np.column_stack([answer, columns])
    filtered = rows[complete]
    for _ in range(WHITENING_ROUNDS):
        weights = np.linalg.lstsq(filtered[:, 1:], filtered[:, 0], rcond=None)[0]
        kernel = whitening_filter(answer - columns @ weights, complete, order)
        filtered = convolved(rows, complete, kernel)
        if not len(filtered):  # gaps everywhere
            return 1.0
    left, _ = _residual(filtered[:, 1:], filtered[:, 0])
    return left / len(filtered)


def input_lag(flight: Flight, signal: Source, vehicle: VehicleFile) -> InputLag | None:
    """Return the lag of a flight's rotor speeds or commands behind its state.

    Parameters
    ----------
    flight
        A flight with a pose; the lag counts from the stamps of its body rate.
    signal
        ``rotor_speed`` or ``command``.
    vehicle
        Gives the rotors' places, and thrust up to a factor.

    Returns
    -------
    InputLag or None
        None where it cannot be estimated.
    """
    clock = flight.time[TRIMMED_SAMPLES:-TRIMMED_SAMPLES]
    rows = flight.series[signal]
    if len(clock) < 200 or not np.isfinite(rows.values).any(axis=0).all():
        return None
    state = states_at(flight.series, clock)
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 (slow to import, seldom needed)

    body = Rotation.from_quat(state.attitude, scalar_first=True).inv()
    moving = body.apply(state.velocity)
    faster = np.gradient(state.velocity, clock, axis=0)
    force = body.apply(faster + np.array([0.0, 0.0, GRAVITY]))
    turning = np.gradient(state.body_rate, clock, axis=0)
    if not (np.isfinite(force).all() and np.isfinite(turning).all()):
        return None
    thrust = squared_speed(vehicle, signal, linear_interpolation(rows, clock))
    place = np.array([rotor.position for rotor in vehicle.rotors])
    spin = np.array([1.0 if rotor.spin == "ccw" else -1.0 for rotor in vehicle.rotors])
    driven = np.column_stack(
        [thrust @ place[:, 1], -thrust @ place[:, 0], -thrust @ spin, thrust.sum(axis=1)]
    )
    rate, along = state.body_rate, np.abs(moving[:, 2:])
    across = (moving[:, :2] ** 2).sum(axis=1, keepdims=True)
    damping = [
        np.column_stack([rate[:, 0], moving[:, 1]]),
        np.column_stack([rate[:, 1], moving[:, 0]]),
        rate[:, 2:],
        np.column_stack([moving[:, 2:], along, across]),
    ]
    answers = np.column_stack([turning, force[:, 2]])
    of_axes = np.stack(
        [
            _likelihoods(answers[:, axis], driven[:, axis], damping[axis], flight.rate)
            for axis in range(4)
        ]
    )
    return _likeliest_lag(of_axes / CORRELATED_FREQUENCIES)


def _likelihoods(answer: Array, driven: Array, damping: Array, rate: float) -> Array:
    """Return the log-likelihood of every lag of `LAGS_S` for one axis."""
    frequency = np.fft.rfftfreq(len(answer), 1.0 / rate)
    inside = (frequency > BAND_HZ[0]) & (frequency < BAND_HZ[1])
    taper = np.hanning(len(answer))[:, None]

    def spectrum(columns: Array) -> Spectrum:
        centred = (columns - columns.mean(axis=0)) * taper
        transformed: Spectrum = np.fft.rfft(centred, axis=0)[inside]
        return transformed

    there, moved = _real(spectrum(answer[:, None]))[:, 0], spectrum(driven[:, None])
    others, turn = _real(spectrum(damping)), 2j * np.pi * frequency[inside][:, None]
    left, _ = _residual(others, there)
    gains = []
    for late in LAGS_S:
        remains, weight = _residual(np.hstack([others, _real(moved * np.exp(turn * late))]), there)
        gains.append(inside.sum() * np.log(left / remains) if weight > 0 else 0.0)
    return np.array(gains)


def _residual(matrix: Array, there: Array) -> tuple[float, float]:
    """Return the residual sum of squares of a column, and the last regressor's weight."""
    weights = np.linalg.lstsq(matrix, there, rcond=None)[0]
    return float(np.sum((there - matrix @ weights) ** 2)), float(weights[-1])


def _real(columns: Spectrum) -> Array:
    return np.concatenate([columns.real, columns.imag])


def _likeliest_lag(of_axes: Array) -> InputLag | None:
    """Return the likeliest lag of all axes, by the parabola through the peak of their sum.

    None for no sharp peak. Where the axes contradict each other by more than chance, the standard
    deviation grows by Birge's ratio. ``of_axes`` (axes, lags) are log-likelihoods.
    """
    likelihood = of_axes.sum(axis=0)
    at = int(np.argmax(likelihood))
    if at in (0, len(LAGS_S) - 1):
        return None
    before, top, after = likelihood[at - 1 : at + 2]
    bend, step = before - 2.0 * top + after, float(LAGS_S[1] - LAGS_S[0])
    if bend >= 0.0:
        return None
    fallen = 2.0 * np.sum(of_axes.max(axis=1) - of_axes[:, at])
    birge = np.sqrt(max(fallen / (len(of_axes) - 1), 1.0))
    sd = birge * step / np.sqrt(-bend)
    place = float(LAGS_S[at] + 0.5 * (before - after) / bend * step)
    return InputLag(place, float(sd)) if sd < MAX_LAG_SD_S else None


WINDOW_S = 0.25
"""Window over which signals are averaged."""
READS_PER_WINDOW = 10
"""Samples of rotor signals in each window."""
MIN_SIDE_S = 4.0
"""Least duration on either side of a change: a shorter one is neither tested nor used."""
MIN_STATISTIC = 100.0
"""Least value of twice the log-likelihood ratio. On 47 flights without a change, simulated ones in
gusts and real ones, the largest was 64; 5 % of a rotor's thrust have a thousand."""
MIN_THRUST_CHANGE = 0.02
"""Least relative change of a rotor's thrust."""
MIN_SHARE_EXPLAINED = 0.5
"""Least share of the squared step of all rotors that a change of one explains."""
RISE_RATIO = 0.8
"""Least rise over the deepest fall of a share for which the rising rotor is the changed one."""
SHARE_SD = 3e-4
"""Standard deviation of a share in the best recordings."""
MAX_AUTOREGRESSION = 0.95


@dataclass(frozen=True)
class RotorChange:
    """A rotor that changes within a flight.

    Attributes
    ----------
    seconds
        Time of the change since the flight's start, s.
    rotor
        Its number, from 0.
    loss
        Share of its thrust at a given speed that it loses; negative for a gain.
    """

    seconds: float
    rotor: int
    loss: float


def cut_at_rotor_changes(
    recordings: Sequence[JobFlight], vehicle: VehicleFile
) -> tuple[tuple[JobFlight, ...], tuple[Finding, ...]]:
    """Return recordings cut off before a rotor changes, and findings on those changes."""
    kept, findings = [], []
    for recording in recordings:
        flight, change = recording.flight, rotor_change_of(recording.flight, vehicle)
        if change is None:
            kept.append(recording)
        else:
            x, y, _ = vehicle.rotors[change.rotor].position
            place = f"{'front' if x > 0.0 else 'rear'} {'left' if y > 0.0 else 'right'}"
            findings.append(
                Code.ROTOR_CHANGED.warning(
                    flight.name,
                    place,
                    seconds=change.seconds,
                    rotor=change.rotor + 1,
                    loss=change.loss,
                )
            )
            kept.append(replace(recording, flight=flight.until(change.seconds - WINDOW_S)))
    return tuple(kept), tuple(findings)


def rotor_change_of(flight: Flight, vehicle: VehicleFile) -> RotorChange | None:
    """Return the rotor that changes within a flight; None if none does, or signals are missing.

    Parameters
    ----------
    flight
        A flight with a pose, body rates, and rotor speeds or commands.
    vehicle
        Gives the curve from command to speed, where only commands were recorded.
    """
    source: Source = "rotor_speed" if flight.has_tachometers else "command"
    recorded = {"position", "attitude", "body_rate", source} <= set(flight.series)
    if not recorded or len(vehicle.rotors) != 4 or flight.duration < 2.0 * MIN_SIDE_S:
        return None
    edges = np.arange(0.0, flight.duration, WINDOW_S)
    shares = _shares(flight, vehicle, source, edges)
    motion = _motion(flight, edges)
    whole = finite_rows(shares) & finite_rows(motion)
    least = round(MIN_SIDE_S / WINDOW_S)
    if whole.sum() < max(2 * least, 2 * motion.shape[1]):
        return None
    return _step(shares[whole], motion[whole], edges[:-1][whole], flight.duration)


def _shares(flight: Flight, vehicle: VehicleFile, source: Source, edges: Array) -> Array:
    """Return each rotor's squared speed over the mean of all (n, 4), window by window."""
    series = flight.series[source]
    fine = (
        edges[:-1, None] + (np.arange(READS_PER_WINDOW) + 0.5) * WINDOW_S / READS_PER_WINDOW
    ).ravel()
    read = np.full((len(fine), 4), np.nan)
    for rotor, column in enumerate(series.values.T):
        there = np.isfinite(column)
        if there.sum() > len(edges):
            read[:, rotor] = np.interp(fine, series.time[there], column[there])
    squares = squared_speed(vehicle, source, read).reshape(-1, READS_PER_WINDOW, 4).mean(axis=1)
    return np.asarray(squares / squares.mean(axis=1, keepdims=True))


def _motion(flight: Flight, edges: Array) -> Array:
    """Return the regressors (n, k) of the shares, window by window."""
    middle = 0.5 * (edges[1:] + edges[:-1])
    rates = local_parabolas(flight.series["body_rate"], edges)
    state = states_at(flight.series, middle)
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 (slow to import, seldom needed)

    turned = Rotation.from_quat(np.nan_to_num(state.attitude, nan=0.5), scalar_first=True)
    through = turned.inv().apply(state.velocity)
    fast = np.linalg.norm(through, axis=1, keepdims=True)
    heading = np.unwrap(turned.as_euler("ZYX")[:, 0])
    wind = np.column_stack([np.cos(heading), np.sin(heading)])
    rate = state.body_rate
    columns = [
        np.diff(rates, axis=0) / WINDOW_S,
        through,
        fast * through,
        rate,
        rate[:, :2] * rate[:, 2:],
        wind if np.ptp(heading) > 0.5 else wind[:, :0],
        np.ones((len(middle), 1)),
    ]
    return np.hstack(columns)


def _step(shares: Array, motion: Array, begins: Array, end: float) -> RotorChange | None:
    """Return the likeliest step of shares (n, 4) at one of the windows' begins (n,), if any."""
    memory, likeliest = 0.0, None
    for _ in range(3):
        steps = list(_steps(shares, motion, begins, end, memory))
        if not steps:
            return None
        likeliest = max(steps, key=lambda step: step[0])
        left = shares - motion @ likeliest[2] - (begins >= likeliest[1])[:, None] * likeliest[3]
        before, after = left[:-1], left[1:]
        memory = float(
            np.clip(np.sum(before * after) / max(np.sum(before**2), 1e-300), 0, MAX_AUTOREGRESSION)
        )
    assert likeliest is not None
    gain, seconds, _, moved = likeliest
    rises = moved.max() > -RISE_RATIO * moved.min()
    rotor = int(np.argmax(moved) if rises else np.argmin(moved))
    alone = np.eye(4)[rotor] - 0.25
    loss = float(alone @ moved / (alone @ alone))
    left_over = np.sum((moved - loss * alone) ** 2) / max(np.sum(moved**2), 1e-300)
    if (
        gain < MIN_STATISTIC
        or abs(loss) < MIN_THRUST_CHANGE
        or left_over > 1.0 - MIN_SHARE_EXPLAINED
    ):
        return None
    return RotorChange(seconds, rotor, loss)


def _steps(
    shares: Array, motion: Array, begins: Array, end: float, memory: float
) -> Iterator[tuple[float, float, Array, Array]]:
    """Return gain, time, coefficients (k, 4) and step (4,) of a step at each time in turn."""

    def whitened(rows: Array) -> Array:
        return np.concatenate([np.sqrt(1.0 - memory**2) * rows[:1], rows[1:] - memory * rows[:-1]])

    answers, columns = whitened(shares), whitened(motion)
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-12)
    basis, values, across = np.linalg.svd(columns / size, full_matrices=False)
    kept = values > 1e-6 * values[0]
    basis, inverse = basis[:, kept], (across[kept].T / values[kept]) / size[:, None]
    left = answers - basis @ (basis.T @ answers)
    freedom = len(answers) - basis.shape[1] - 1
    three = np.linalg.qr(np.eye(4) - 0.25)[0][:, :3]  # shares add up to four
    for seconds in begins[(begins >= MIN_SIDE_S) & (begins <= end - MIN_SIDE_S)]:
        step = whitened((begins >= seconds).astype(float)[:, None])[:, 0]
        alone = step - basis @ (basis.T @ step)
        square = alone @ alone
        if square < 1e-3 * (step @ step):
            continue  # the motion changes with it
        moved = alone @ left / square
        after = (left - np.outer(alone, moved)) @ three
        scatter = after.T @ after / freedom + SHARE_SD**2 * np.eye(3)
        gain = float(square * (moved @ three) @ np.linalg.solve(scatter, moved @ three))
        theta = inverse @ (basis.T @ (answers - np.outer(step, moved)))
        yield gain, float(seconds), theta, moved
