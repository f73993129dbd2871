"""The controller file's rate loop, replayed on recorded set-points and body rates, before a search.

A rate controller is a function of its set-point and of the gyro. Both were recorded, as were the
motor commands that it gave: replayed with the controller file's gains, filters and rate, it gives
the torque set-points of the recorded commands, but for noise. What is left is correlated with
instruments: what the replay's settings would change about it on body rates as set-points and
earlier commands predict them, which have no noise of the recorded gyro (Ljung, System
Identification, 7.6). Where it is more than chance (Hansen, Econometrica 50, 1982), the few settings
are looked for with which it is not.

When a loop ran is not in a recording, nor how long a set-point was on its way: two delays are free
within what is usual. Where stamps are uneven, they say nothing of the loop's rate.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

from sim_jax.control.gains import Filters, MixerSettings
from sim_jax.control.mixer import LOW_CLIP, torque_of
from sim_jax.control.rate import INTEGRAL_FADE
from sim_jax.sensing import GyroFilter
from tuner.core.numerics import Array, unit_diagonal
from tuner.equation_error.rate_controller import AXES, MEMORY_S, square_of_sum
from tuner.findings.findings import Code, Finding
from tuner.objective.inlets import zero_order_hold
from tuner.recordings.flight import Flight, Series
from tuner.vehicle import ControllerFile
from tuner.vehicle.model import controller_of

SIGNALS = ("rate_setpoint", "body_rate", "command")
"""Recorded inputs and output of a rate controller."""
SAMPLE_S, STRETCH_S, MIN_STRETCH_S, SETTLING_S = 0.01, 4.0, 1.0, 0.5
"""Least s between samples that are used; longest and shortest stretch of them, each with its own
bias and ramp, as of a gyro's bias in an integral; and s after a flight's begin in which filters
settle."""
LAGS, FIRST_LAG = 13, 2
"""Samples of set-points and of earlier commands that predict a body rate, and the latter's first:
noise that the loop hears has passed by then."""
MAX_GAP = 3.0
"""Longest gap between samples of the gyro through which it is interpolated, in usual ones."""
UNEVEN_S = 1e-4
"""Range of gaps between stamps from which these do not show when a loop ran."""
RATES = (400, 250, 800, 1000)
"""Hz of common rate loops, the likeliest first (PX4 IMU_GYRO_RATEMAX; 250 in its simulations)."""
ROTORS = 4
Rows = NDArray[np.intp]
PARTS = ("p", "i", "d", "ff", "k")
CUTOFFS = ("gyro_cutoff", "dgyro_cutoff")
DELAY_SD = {True: {"late": 5e-4}, False: {"late": 1e-3, "setpoint_late": 2e-3}}
"""s by which the gyro and set-points may come later than stamped, where stamps are even or not."""
CUTOFF_STEP, DELAY_STEP = 0.05, {"late": 1e-3, "setpoint_late": 5e-3}
"""Differences by which derivatives are computed."""
MAX_STEP = 0.7
"""Largest step in the logarithm of a cut-off."""
ITERATIONS, MAX_SETTINGS = 4, 6
MIN_DROP, MIN_SHARE, MIN_SHARE_OF_RATE = 25.0, 0.7, 0.9
"""Least drop of the test's statistic by a setting, and by all of them over what is more than
chance, also where the rate is among them."""
ALIKE = 9.0
"""Difference of the statistic within which the likelier rate is taken."""
MAX_SECONDS = 90.0
"""s of all flights that are replayed."""
MIN_CHANGE = {
    "p": 0.1,
    "i": 0.2,
    "d": 0.3,
    "ff": 0.05,
    "k": 0.1,
    "gyro_cutoff": 0.15,
    "dgyro_cutoff": 0.3,
}
"""Least reported differences over the file's values."""
TYPICAL_SHARE = {"i": 0.5, "d": 0.01, "ff": 1.0}
"""Shares of P that stand for a file's value below them."""
MAX_FACTOR = 4.0
"""Largest ratio of P, or of K, to the file's, either way: beyond it the commands are not a rate
loop's of these set-points, but those of motors in another order, or of another flight."""
MIN_DEVIATION = 5.0
"""Least reported difference in standard errors."""
MIN_RECIPROCAL_CONDITION = 1e-5


@dataclass(frozen=True)
class Settings:
    """Settings of a rate loop.

    Attributes
    ----------
    gains
        (3, 5) of roll, pitch, yaw: P, I, D, FF and K, by which the first three are multiplied.
    rate
        Hz.
    gyro_cutoff, dgyro_cutoff
        Hz; None for no filter.
    late, setpoint_late
        s by which body rates and set-points come later than stamped.
    """

    gains: Array
    rate: float
    gyro_cutoff: float | None
    dgyro_cutoff: float | None
    late: float = 0.0
    setpoint_late: float = 0.0

    @staticmethod
    def of(controller: ControllerFile) -> Settings:
        """Return those of a controller file."""
        loop, filters = controller.rate, controller.filters
        gains = [[getattr(getattr(loop, axis), part) for part in PARTS] for axis in AXES]
        return Settings(np.array(gains), loop.rate, filters.gyro_cutoff, filters.dgyro_cutoff)

    def moved(self, name: str, by: float) -> Settings:
        """Return settings with one moved: a delay, s, a cut-off by its logarithm, or a gain."""
        if name in DELAY_STEP:
            return replace(self, **{name: getattr(self, name) + by})
        if name in CUTOFFS:
            most = 0.98 * 0.5 * self.rate
            cutoff = getattr(self, name) * float(np.exp(np.clip(by, -MAX_STEP, MAX_STEP)))
            return replace(self, **{name: min(cutoff, most)})
        gains = self.gains.copy()
        gains[_place(name)] += by
        return replace(self, gains=gains)

    def value(self, name: str) -> float:
        """Return the value of a gain or of a cut-off, Hz, in the file's units."""
        return float(getattr(self, name) if name in CUTOFFS else self.gains[_place(name)])

    def torque(self, parts: Array) -> Array:
        """Return torques (N, 3) of what each gain multiplies, as of `_Loop.replayed`."""
        factors = self.gains[:, :4] * np.column_stack([*[self.gains[:, 4]] * 3, np.ones(3)])
        return np.asarray(np.einsum("nak,ak->na", parts, factors))


def _place(name: str) -> tuple[int, int]:
    """Return row and column of a gain, as ``roll.p``."""
    axis, part = name.split(".")
    return AXES.index(axis), PARTS.index(part)


@dataclass(frozen=True)
class _Loop:
    """A flight's rate loop at N samples, axes FRD.

    Attributes
    ----------
    time, torque
        s, and the torque set-points (N, 3) of the recorded commands.
    stretches
        Rows of samples in which no motor is at its limit.
    setpoint
        rad/s, as recorded.
    read, predicted
        Body rate by time, rad/s, as recorded and as the instruments have it.
    even
        Whether stamps show when the loop ran.
    """

    time: Array
    torque: Array
    stretches: list[Rows]
    setpoint: Series
    read: CubicSpline
    even: bool
    predicted: CubicSpline = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "predicted", CubicSpline(self.time, self._rates()))

    @staticmethod
    def of(flight: Flight, mixer: MixerSettings, seconds: float) -> _Loop | None:
        """Return the loop of a flight's first seconds; None where it lacks signals, or clips."""
        if not all(flight.has(name) for name in SIGNALS):
            return None
        known = {}
        for name in SIGNALS:
            series = flight.series[name]
            there = np.isfinite(series.values).all(axis=1)
            there &= np.diff(series.time, prepend=-np.inf) > 0.0
            known[name] = Series(series.time[there], series.values[there])
        told, gyro, command = (known[name] for name in SIGNALS)
        fewest, least = min(len(part.time) for part in known.values()), LAGS + FIRST_LAG + 2
        if fewest < least or command.values.shape[1] != ROTORS:
            return None
        even = all(float(np.ptp(np.diff(part.time))) < UNEVEN_S for part in known.values())
        begin = max(gyro.time[0], told.time[0])
        end = min(gyro.time[-1], begin + seconds)
        inside = np.flatnonzero((command.time >= begin) & (command.time <= end))
        if len(inside) < least:
            return None
        gap = float(np.median(np.diff(command.time)))
        inside = inside[:: max(1, round(SAMPLE_S / gap))]
        time, commands = command.time[inside], command.values[inside]
        torque = torque_of(mixer, tuple(commands.T))
        free = ((commands > LOW_CLIP) & (commands < 1.0 - LOW_CLIP)).all(axis=1)
        gaps = np.diff(gyro.time)
        unseen = gaps > MAX_GAP * np.median(gaps)
        free &= ~unseen[np.clip(np.searchsorted(gyro.time, time) - 1, 0, len(gaps) - 1)]
        free &= time > time[0] + SETTLING_S
        stretches = _stretches(time, free)
        turned = np.array([1.0, -1.0, -1.0])
        if not stretches:
            return None
        return _Loop(
            time,
            np.column_stack([np.asarray(axis) for axis in (torque.x, torque.y, torque.z)]),
            stretches,
            Series(told.time, told.values[:, :3] * turned),
            CubicSpline(gyro.time, gyro.values * turned),
            even,
        )

    def _rates(self) -> Array:
        """Return body rates (N, 3) as set-points and earlier commands predict them.

        Each half of the stretches is predicted by the other's regression: a sample's own noise has
        no part in it.
        """
        read, asked = self.read(self.time), zero_order_hold(self.setpoint, self.time)
        half = ((self.time - self.time[0]) // STRETCH_S).astype(int) % 2
        predicted = np.zeros_like(read)
        for axis in range(3):
            lagged = [_lagged(asked[:, axis], lag) for lag in range(LAGS)]
            lagged += [_lagged(self.torque[:, axis], lag + FIRST_LAG) for lag in range(LAGS)]
            columns = np.column_stack([np.ones(len(read)), *lagged])
            columns /= np.linalg.norm(columns, axis=0) + 1e-300
            for own in (0, 1):
                there = half != own
                by, *_ = np.linalg.lstsq(columns[there], read[there, axis], rcond=1e-6)
                predicted[~there, axis] = columns[~there] @ by
        return np.asarray(predicted)

    def replayed(self, settings: Settings, rates: CubicSpline) -> Array:
        """Return what each gain multiplies, (N, 3 axes, 4): error, integral, -acceleration, FF."""
        rate = settings.rate
        first, last = np.ceil(self.time[0] * rate - 1e-6), np.floor(self.time[-1] * rate + 1e-6)
        tick = np.arange(first, last + 1) / rate
        turning, asked = rates(tick - settings.late), self._asked(tick - settings.setpoint_late)
        low_pass, share = _filters(settings.gyro_cutoff, settings.dgyro_cutoff, rate)
        if low_pass:
            b0, a1, a2 = low_pass
            settled = np.array([1.0 - b0, b0 - a2])[:, None] * turning[:1]
            by = [b0, 2.0 * b0, b0], [1.0, a1, a2]
            turning = lfilter(*by, turning, axis=0, zi=settled)[0]
        faster = np.diff(turning, axis=0, prepend=turning[:1]) * rate
        if share:
            faster = lfilter([share], [1.0, share - 1.0], faster, axis=0)
        error = asked - turning
        steps = np.maximum(1.0 - (error / INTEGRAL_FADE) ** 2, 0.0) * error / rate
        parts = np.stack([error, np.cumsum(steps, axis=0) - steps, -faster, asked], axis=-1)
        held = np.searchsorted(tick, self.time + 1e-6, side="right") - 1
        return np.asarray(parts[np.maximum(held, 0)])

    def _asked(self, time: Array) -> Array:
        """Return set-points (n, 3): those that hold, or smoothed where none knows since when."""
        if self.even:
            return zero_order_hold(self.setpoint, time)
        half = 0.5 * float(np.median(np.diff(self.setpoint.time)))
        return np.column_stack(
            [np.interp(time - half, self.setpoint.time, axis) for axis in self.setpoint.values.T]
        )

    def detrended(self, series: Array) -> Array:
        """Return the rows of all stretches (n, ...), each less its mean and its slope."""
        parts = []
        for rows in self.stretches:
            line = np.linspace(-1.0, 1.0, len(rows))
            about = series[rows] - series[rows].mean(axis=0)
            slope = np.tensordot(line, about, 1) / (line @ line)
            parts.append(about - np.multiply.outer(line, slope))
        return np.concatenate(parts)


@lru_cache(64)
def _filters(
    gyro_cutoff: float | None, dgyro_cutoff: float | None, rate: float
) -> tuple[tuple[float, ...], float]:
    """Return the gyro filter's b0, a1, a2 and the derivative's share; empty, zero for none."""
    cutoffs = (None if of is None else jnp.asarray(of) for of in (gyro_cutoff, dgyro_cutoff))
    prepared = GyroFilter.at(Filters(*cutoffs), rate)
    of_rate = (prepared.b0, prepared.a1, prepared.a2)
    share = prepared.derivative_share
    low_pass = tuple(float(np.asarray(one)) for one in of_rate if one is not None)
    return low_pass, 0.0 if share is None else float(np.asarray(share))


def _stretches(time: Array, free: NDArray[np.bool_]) -> list[Rows]:
    """Return the rows of stretches of free samples (N,) no longer and no shorter than allowed."""
    rows = np.flatnonzero(free)
    gap = float(np.median(np.diff(time)))
    runs = np.split(rows, 1 + np.flatnonzero(np.diff(rows) > 1))
    least, most = max(10, round(MIN_STRETCH_S / gap)), STRETCH_S / gap
    return [
        part
        for run in runs
        if len(run) >= least
        for part in np.array_split(run, max(1, int(len(run) / most)))
    ]


def _lagged(series: Array, lag: int) -> Array:
    return np.concatenate([np.full(lag, series[0]), series[: len(series) - lag]])


@dataclass(frozen=True)
class _Test:
    """The moments of residuals with instruments at some settings, and their derivatives.

    Attributes
    ----------
    moments
        (m,), each of unit variance if its weights are those of the residuals.
    slopes
        Name -> (m,), by which a move of that setting lowers them.
    delay_sd
        Name of a delay -> its standard deviation, s.
    """

    settings: Settings
    moments: Array
    slopes: Mapping[str, Array]
    delay_sd: Mapping[str, float]

    @property
    def statistic(self) -> float:
        """The statistic of Hansen's test, the delays where they make it least."""
        return self.fitted(())[0]

    def fitted(self, names: Sequence[str]) -> tuple[float, Array, Array]:
        """Return the statistic with some settings moved, with delays; moves, standard errors."""
        slopes = np.column_stack([self.slopes[name] for name in (*self.delay_sd, *names)])
        now = np.array([getattr(self.settings, name) for name in self.delay_sd])
        sd = np.array(list(self.delay_sd.values()))
        prior = np.eye(len(sd), slopes.shape[1]) / sd[:, None]
        rows, aim = np.vstack([slopes, prior]), np.append(self.moments, -now / sd)
        size = np.linalg.norm(rows, axis=0) + 1e-300
        inverse = np.linalg.pinv(rows / size, rcond=1e-6)
        moves = inverse @ aim
        left = aim - rows @ (moves / size)
        return float(left @ left), moves / size, np.linalg.norm(inverse, axis=1) / size


class _Replay:
    """Replays of flights, and tests of settings against them."""

    def __init__(self, loops: Sequence[_Loop], of_file: Settings) -> None:
        self.loops, self.of_file = loops, of_file
        even = all(loop.even for loop in loops)
        self.delay_sd = DELAY_SD[even]
        most = max(of_file.gyro_cutoff or 0.0, of_file.dgyro_cutoff or 0.0)
        self.rates = [r for r in RATES if even and r != of_file.rate and most < 0.49 * r]
        self.instruments = [self._instruments(loop) for loop in loops]

    def _instruments(self, loop: _Loop) -> Array:
        """Return the instruments (n, 3 axes, m) of a flight."""
        file, by = self.of_file, loop.predicted
        slopes = [*self._slopes(loop, file, by).values()]
        plain = file.torque(loop.replayed(file, by))
        others = [replace(file, rate=float(rate)) for rate in self.rates]
        slopes += [other.torque(loop.replayed(other, by)) - plain for other in others]
        return loop.detrended(np.stack(slopes, axis=-1))

    def _slopes(self, loop: _Loop, at: Settings, rates: CubicSpline) -> dict[str, Array]:
        """Return name -> derivative (N, 3) of torques by a setting."""
        parts, slopes = loop.replayed(at, rates), {}
        for row, axis in enumerate(AXES):
            p, i, d, _, k = at.gains[row]
            error, integral, slowing, asked = parts[:, row].T
            own = k * error, k * integral, k * slowing, asked
            for part, by in zip(PARTS, (*own, p * error + i * integral + d * slowing), strict=True):
                slopes[f"{axis}.{part}"] = np.zeros(parts.shape[:2])
                slopes[f"{axis}.{part}"][:, row] = by
        steps = {name: CUTOFF_STEP for name in CUTOFFS if getattr(at, name)} | DELAY_STEP
        for name, step in steps.items():
            ends = [at.moved(name, sign * 0.5 * step) for sign in (1.0, -1.0)]
            more, less = (end.torque(loop.replayed(end, rates)) for end in ends)
            slopes[name] = (more - less) / step
        return slopes

    def _residuals(self, at: Settings) -> Iterator[tuple[_Loop, Array, Array]]:
        """Yield each flight, its instruments, and its residuals (n, 3)."""
        for loop, instruments in zip(self.loops, self.instruments, strict=True):
            left = loop.torque - at.torque(loop.replayed(at, loop.read))
            yield loop, instruments, loop.detrended(left)

    def weights(self, at: Settings) -> Array:
        """Return the weights (m, instruments) of moments of unit variance with these residuals."""
        square = np.zeros((self.instruments[0].shape[-1],) * 2)
        for loop, instruments, left in self._residuals(at):
            memory = max(1, round(MEMORY_S / float(np.median(np.diff(loop.time)))))
            for axis in range(len(AXES)):
                square += square_of_sum(instruments[:, axis], left[:, axis], memory)
        unit = unit_diagonal(square)
        sizes, axes = np.linalg.eigh(square * np.outer(unit, unit))
        kept = sizes > MIN_RECIPROCAL_CONDITION
        return np.asarray((axes[:, kept] / np.sqrt(sizes[kept])).T * unit)

    def test(self, at: Settings, weights: Array) -> _Test:
        """Return the test of some settings."""
        total, slopes = np.zeros(weights.shape[1]), dict[str, Array]()
        for loop, instruments, left in self._residuals(at):
            total += np.einsum("nam,na->m", instruments, left)
            for name, slope in self._slopes(loop, at, loop.read).items():
                own = np.einsum("nam,na->m", instruments, loop.detrended(slope))
                slopes[name] = slopes.get(name, 0.0) + weights @ own
        return _Test(at, weights @ total, slopes, self.delay_sd)

    def settled(self, at: Settings, names: Sequence[str], weights: Array) -> _Test:
        """Return the test where some settings are those that flew."""
        for _ in range(ITERATIONS if {*CUTOFFS} & {*names} else 1):
            _, moves, _ = self.test(at, weights).fitted(names)
            for name, move in zip((*self.delay_sd, *names), moves.tolist(), strict=True):
                at = at.moved(name, move)
        return self.test(at, weights)


def rate_loop_findings(flights: Sequence[Flight], controller: ControllerFile) -> Iterator[Finding]:
    """Return a finding on settings of the rate loop other than the controller file's, if they are.

    Parameters
    ----------
    flights
        Flights whose rate loop is to be simulated; those without its signals say nothing.
    """
    mixer, of_file = controller_of(controller).mixer, Settings.of(controller)
    each = MAX_SECONDS / max(len(flights), 1)
    loops = [loop for flight in flights if (loop := _Loop.of(flight, mixer, each))]
    if not loops:
        return
    found = _settings_that_flew(_Replay(loops, of_file))
    numbers = dict[str, float]()
    for name, (value, error, in_file) in found.items():
        numbers |= {name: value, f"{name}_error": error, f"{name}_file": in_file}
    if found:
        yield Code.RATE_LOOP_DIFFERS.warning("controller file", *found, **numbers)


def _settings_that_flew(replay: _Replay) -> dict[str, tuple[float, float, float]]:
    """Return the name of each setting that differs -> its value, its error, the file's."""
    file, names = replay.of_file, list[str]()
    weights = replay.weights(file)
    test = replay.test(file, weights)
    chance = len(test.moments)
    while test.statistic > chance + MIN_DROP and len(names) < MAX_SETTINGS:
        trials = []
        if left := [name for name in test.slopes if _is_apart(name, names)]:
            best = min(left, key=lambda name: test.fitted([*names, name])[0])
            trials.append((test, [*names, best]))
        if test.settings.rate == file.rate:
            others = [replace(test.settings, rate=float(rate)) for rate in replay.rates]
            trials += [(replay.test(other, weights), names) for other in others]
        enough = test.statistic - MIN_DROP
        trials = [(one, moved) for one, moved in trials if one.fitted(moved)[0] < enough]
        settled = [replay.settled(one.settings, moved, weights) for one, moved in trials]
        if not settled or min(one.statistic for one in settled) > enough:
            break
        least = min(one.statistic for one in settled)
        nearest = next(n for n, one in enumerate(settled) if one.statistic < least + ALIKE)
        names = trials[nearest][1]
        weights = replay.weights(settled[nearest].settings)
        test = replay.settled(settled[nearest].settings, names, weights)
    if test.settings.rate != file.rate:
        own = replay.settled(replace(test.settings, rate=file.rate), names, weights)
        if own.statistic - test.statistic < MIN_DROP:
            test = own
    at, before = test.settings, replay.settled(file, (), weights).statistic
    share = MIN_SHARE if at.rate == file.rate else MIN_SHARE_OF_RATE
    if before - test.statistic < max(MIN_DROP, share * (before - chance)):
        return {}
    misfit = max(1.0, test.statistic / chance) ** 0.5  # Birge, Phys. Rev. 40, 1932
    errors = misfit * test.fitted(names)[2][len(replay.delay_sd) :]
    found = {} if at.rate == file.rate else {"rate.rate": (at.rate, 0.0, file.rate)}
    for name, error in zip(names, errors.tolist(), strict=True):
        value, of_file = max(at.value(name), 0.0), file.value(name)
        if (
            name.endswith((".p", ".k"))
            and not of_file < MAX_FACTOR * value < MAX_FACTOR**2 * of_file
        ):
            return {}
        sd = error * value if name in CUTOFFS else error
        off = max(MIN_DEVIATION * sd, _least_change(name, file))
        if abs(value - of_file) > off:
            found[f"{'filters' if name in CUTOFFS else 'rate'}.{name}"] = (value, sd, of_file)
    return found


def _least_change(name: str, file: Settings) -> float:
    """Return the least reported difference of a setting."""
    of_file, part = file.value(name), name.rpartition(".")[2]
    if part in ("i", "d", "ff"):
        p = file.gains[_place(name)[0], 0]
        of_file = max(of_file, TYPICAL_SHARE[part] * p)
    return MIN_CHANGE[part] * of_file


def _is_apart(name: str, names: Sequence[str]) -> bool:
    """Return whether a setting is another than some, and not K of an axis beside its P, I or D."""
    if name in (*DELAY_STEP, *names):
        return False
    axis, _, part = name.partition(".")
    others = ("p", "i", "d") if part == "k" else ("k",) if part in ("p", "i", "d") else ()
    return not any(f"{axis}.{other}" in names for other in others)
