"""Detection of a change of a rotor within a flight, as by a damaged propeller.

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

from tuner.core.numerics import Array
from tuner.findings.findings import Code, Finding
from tuner.objective.rotor_signals import Source, squared_speed
from tuner.recordings.flight import Flight
from tuner.recordings.states import local_parabolas, states_at
from tuner.search.job_flights import Recording
from tuner.vehicle import VehicleFile

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
"""Largest autoregression from window to window."""


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
    recordings: Sequence[Recording], vehicle: VehicleFile
) -> tuple[tuple[Recording, ...], tuple[Finding, ...]]:
    """Return recordings cut off before a rotor changes, and findings on those changes."""
    kept, findings = [], []
    for recording in recordings:
        flight, change = recording.flight, rotor_change_of(recording.flight, vehicle)
        if change is None:
            kept.append(recording)
        else:
            x, y, _ = vehicle.rotors[change.rotor].position
            place = f"{'front' if x > 0.0 else 'rear'} {'left' if y > 0.0 else 'right'}"
            numbers = {"seconds": change.seconds, "rotor": change.rotor + 1, "loss": change.loss}
            findings.append(Finding(Code.ROTOR_CHANGED, "warning", flight.name, numbers, (place,)))
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
    source: Source = "rotor_speed" if flight.tells_speeds else "command"
    known = {"position", "attitude", "body_rate", source} <= set(flight.series)
    if not known or len(vehicle.rotors) != 4 or flight.duration < 2.0 * MIN_SIDE_S:
        return None
    edges = np.arange(0.0, flight.duration, WINDOW_S)
    shares = _shares(flight, vehicle, source, edges)
    motion = _motion(flight, edges)
    whole = np.isfinite(shares).all(axis=1) & np.isfinite(motion).all(axis=1)
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
    memory, found = 0.0, None
    for _ in range(3):
        steps = list(_steps(shares, motion, begins, end, memory))
        if not steps:
            return None
        found = max(steps, key=lambda step: step[0])
        left = shares - motion @ found[2] - (begins >= found[1])[:, None] * found[3]
        before, after = left[:-1], left[1:]
        memory = float(
            np.clip(np.sum(before * after) / max(np.sum(before**2), 1e-300), 0, MAX_AUTOREGRESSION)
        )
    assert found is not None
    gain, seconds, _, moved = found
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
