"""A change within a flight: a rotor that from some time on turns otherwise for the same motion.

The motion of a rigid body demands a force and a moment, and four rotors share them in one way. So
each rotor's share of the squared speeds is a function of the motion (angular acceleration, velocity
through the air, body rate, heading for a steady wind), whatever disturbs the flight and however the
loop answers. Where a propeller breaks or a motor slackens, that rotor's share rises from one sample
to the next and stays there, and those of the others fall alike.

Per flight the shares are regressed on the motion, in windows of `WINDOW`, with a step at each time
in turn. What is left is autocorrelated, as gusts are: a first-order autoregression is estimated
with the likeliest step in, and steps are judged by generalised least squares. The statistic is the
largest of all times' (Andrews, "Tests for parameter instability and structural change with unknown
change point", Econometrica 61, 1993).
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

WINDOW = 0.25
"""s over which signals are averaged."""
INSIDE = 10
"""Times in each window at which rotors are read."""
SHORTEST = 4.0
"""s on either side of a change: what is less is neither found nor used."""
LIKELY = 100.0
"""Twice the log-likelihood that a step must gain. On 47 flights without a change, simulated ones in
gusts and real ones among them, the likeliest gained 64; 5 % of a rotor gain a thousand."""
SMALLEST = 0.02
"""Share of its thrust that a rotor must lose or gain."""
STANDS_OUT = 0.5
"""Share of the squared change of all shares that the one rotor's must explain."""
ALIKE = 0.8
"""A rise, over the deepest fall of a share, from which the rising one's rotor has changed."""
READ = 3e-4
"""Of a share: no recording is better."""
MEMORY = 0.95
"""Autoregression from window to window, at most."""


@dataclass(frozen=True)
class Change:
    """A rotor that changes within a flight.

    Attributes
    ----------
    seconds
        s since the flight's start at which.
    rotor
        Its number, from 0.
    loss
        Share of its thrust at a given speed that it loses; negative for a gain.
    """

    seconds: float
    rotor: int
    loss: float


def used_up_to_changes(
    recordings: Sequence[Recording], vehicle: VehicleFile
) -> tuple[tuple[Recording, ...], tuple[Finding, ...]]:
    """Return recordings, held-out ones too, that end before a rotor changes; which ones do."""
    kept, findings = [], []
    for recording in recordings:
        flight, change = recording.flight, change_of(recording.flight, vehicle)
        if change is None:
            kept.append(recording)
        else:
            x, y, _ = vehicle.rotors[change.rotor].position
            place = f"{'front' if x > 0.0 else 'rear'} {'left' if y > 0.0 else 'right'}"
            numbers = {"seconds": change.seconds, "rotor": change.rotor + 1, "loss": change.loss}
            findings.append(Finding(Code.ROTOR_CHANGED, "warning", flight.name, numbers, (place,)))
            kept.append(replace(recording, flight=flight.until(change.seconds - WINDOW)))
    return tuple(kept), tuple(findings)


def change_of(flight: Flight, vehicle: VehicleFile) -> Change | None:
    """Return the rotor that changes within a flight; None if none does, or nothing can be told.

    Parameters
    ----------
    flight
        With a pose, body rates, and rotor speeds or commands.
    vehicle
        Gives the curve from command to speed, where only commands were recorded.
    """
    source: Source = "rotor_speed" if flight.tells_speeds else "command"
    known = {"position", "attitude", "body_rate", source} <= set(flight.series)
    if not known or len(vehicle.rotors) != 4 or flight.duration < 2.0 * SHORTEST:
        return None
    edges = np.arange(0.0, flight.duration, WINDOW)
    shares = _shares(flight, vehicle, source, edges)
    motion = _motion(flight, edges)
    whole = np.isfinite(shares).all(axis=1) & np.isfinite(motion).all(axis=1)
    least = round(SHORTEST / WINDOW)
    if whole.sum() < max(2 * least, 2 * motion.shape[1]):
        return None
    return _step(shares[whole], motion[whole], edges[:-1][whole], flight.duration)


def _shares(flight: Flight, vehicle: VehicleFile, source: Source, edges: Array) -> Array:
    """Return each rotor's squared speed over the mean of all (n, 4), window by window."""
    series = flight.series[source]
    fine = (edges[:-1, None] + (np.arange(INSIDE) + 0.5) * WINDOW / INSIDE).ravel()
    read = np.full((len(fine), 4), np.nan)
    for rotor, column in enumerate(series.values.T):
        there = np.isfinite(column)
        if there.sum() > len(edges):
            read[:, rotor] = np.interp(fine, series.time[there], column[there])
    squares = squared_speed(vehicle, source, read).reshape(-1, INSIDE, 4).mean(axis=1)
    return np.asarray(squares / squares.mean(axis=1, keepdims=True))


def _motion(flight: Flight, edges: Array) -> Array:
    """Return what shares depend on (n, k), window by window."""
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
        np.diff(rates, axis=0) / WINDOW,
        through,
        fast * through,
        rate,
        rate[:, :2] * rate[:, 2:],
        wind if np.ptp(heading) > 0.5 else wind[:, :0],
        np.ones((len(middle), 1)),
    ]
    return np.hstack(columns)


def _step(shares: Array, motion: Array, begins: Array, end: float) -> Change | None:
    """Return the likeliest step of shares (n, 4) at one of the windows' begins (n,), if any."""
    memory, found = 0.0, None
    for _ in range(3):
        steps = list(_steps(shares, motion, begins, end, memory))
        if not steps:
            return None
        found = max(steps, key=lambda step: step[0])
        left = shares - motion @ found[2] - (begins >= found[1])[:, None] * found[3]
        before, after = left[:-1], left[1:]
        memory = float(np.clip(np.sum(before * after) / max(np.sum(before**2), 1e-300), 0, MEMORY))
    assert found is not None
    gain, seconds, _, moved = found
    rises = moved.max() > -ALIKE * moved.min()
    rotor = int(np.argmax(moved) if rises else np.argmin(moved))
    alone = np.eye(4)[rotor] - 0.25
    loss = float(alone @ moved / (alone @ alone))
    left_over = np.sum((moved - loss * alone) ** 2) / max(np.sum(moved**2), 1e-300)
    if gain < LIKELY or abs(loss) < SMALLEST or left_over > 1.0 - STANDS_OUT:
        return None
    return Change(seconds, rotor, loss)


def _steps(
    shares: Array, motion: Array, begins: Array, end: float, memory: float
) -> Iterator[tuple[float, float, Array, Array]]:
    """Return gain, time, coefficients (k, 4) and step (4,) of a step at each time in turn."""

    def new(rows: Array) -> Array:
        return np.concatenate([np.sqrt(1.0 - memory**2) * rows[:1], rows[1:] - memory * rows[:-1]])

    answers, columns = new(shares), new(motion)
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-12)
    basis, values, across = np.linalg.svd(columns / size, full_matrices=False)
    kept = values > 1e-6 * values[0]
    basis, inverse = basis[:, kept], (across[kept].T / values[kept]) / size[:, None]
    left = answers - basis @ (basis.T @ answers)
    freedom = len(answers) - basis.shape[1] - 1
    three = np.linalg.qr(np.eye(4) - 0.25)[0][:, :3]  # shares add up to four
    for seconds in begins[(begins >= SHORTEST) & (begins <= end - SHORTEST)]:
        step = new((begins >= seconds).astype(float)[:, None])[:, 0]
        alone = step - basis @ (basis.T @ step)
        square = alone @ alone
        if square < 1e-3 * (step @ step):
            continue  # the motion changes with it
        moved = alone @ left / square
        after = (left - np.outer(alone, moved)) @ three
        scatter = after.T @ after / freedom + READ**2 * np.eye(3)
        gain = float(square * (moved @ three) @ np.linalg.solve(scatter, moved @ three))
        theta = inverse @ (basis.T @ (answers - np.outer(step, moved)))
        yield gain, float(seconds), theta, moved
