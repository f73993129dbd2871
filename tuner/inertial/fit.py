"""The lags of the motors and the gains from rotor speeds to motion, by prediction error.

With Ω the rotor speeds that follow the commands, f the specific force and h the height of the
rotors over the centre of mass::

    dω/dt = gain · (f_z · Σ lever·Ω² / ΣΩ² + h · (-f_y, f_x)) + damping · ω + coupling · (ω × ω)
            + drag · (f_y, f_x) + offset · (f_z - g) + constant                    about x and y
    dω/dt = gain · Σ lever·Ω² + reaction · dΣ±Ω/dt + spread · (x̄ · f_y - ȳ · f_x)
            + damping · ω + coupling · (ω × ω) + constant                          about z
    f_z   = gain · ΣΩ² + decline · t·ΣΩ² + constant                               along z

What air does to a vehicle that flies fast shows in the accelerometer. Whatever is left of the
rotors' thrust is in f_z, slowly: about x and y the rotors share that, whatever battery and inflow
are. What drags at the rotors is in f_x and f_y, at their height; what else goes with the airspeed
(flapping, a body that drags elsewhere) is a part of those, as large as its prior lets it be. About
z the rotors' drags have arms as their speeds spread them (x̄, ȳ: the rotors' mean place).

What is left is not white, and the loop's rotors answer it. So errors are predicted from those
before them, and what is new in each is weighed (prediction errors with an autoregressive noise
model; Ljung, System Identification, 13.4). The gains are linear: for given lags their best values
are a solve, and the search moves three numbers (variable projection, Golub and Pereyra 1973).
After Eschmann, Albani and Loianno, "Data-Driven System Identification of Quadrotors Subject to
Motor Delays", 2024, who take the lag for symmetric.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, optimize, signal

from sim_jax.constants import GRAVITY
from sim_jax.vehicle import Motor
from tuner.core.numerics import Array, Inverse, scaled_solve
from tuner.inertial.signals import Stretch, blocks_of, low_passed, smoothed
from tuner.objective.rotor_response import Lags, rotor_speeds
from tuner.objective.rotor_signals import levers
from tuner.vehicle import ControllerFile, VehicleFile, values_of
from tuner.vehicle.model import model_of

OUTPUTS = ("roll", "pitch", "yaw", "thrust")
"""What is explained: three angular accelerations in rad/s², the specific force along z in m/s²."""
STEADY = ("steady_roll", "steady_pitch", "steady_yaw")
"""The constants of the first three, in rad/s²."""
NAMES = ("up", "down", "late", *OUTPUTS, *STEADY)
"""The numbers of a `Response`: the lags' coordinates, the gains, the constants."""
CONSTANT, RATE, DRAG = 0, 1, 3
"""The columns of a constant, of the rate, and about x and y of the drag, among those that no lag
moves."""
TRIM_VARIATION = 0.1
"""rad/s² by which what is steady in one flight is another in the next."""
AIRSPEED = 25.0
"""m/s along its axis at which a rotor has lost its thrust, or earlier."""
NOISE_MEMORY = 0.15
"""s of errors from which the next one is predicted."""
GYRO, ACCELEROMETER = 1e-4, 0.02
"""rad/s and m/s² of white noise that any sensor has: a simulated log may hold none."""
BIAS = 0.1
"""m/s², standard deviation of the accelerometer's error along z."""
THRUST_BAND = 3.0
"""Hz, up to which the accelerometer tells what is left of the rotors' thrust."""
DRAG_BAND = 8.0
"""Hz, up to which it tells what drags."""
HEIGHT = 0.3
"""Standard deviation, in arms, of the height at which what goes with the airspeed acts."""
DRAG_MOMENT_ERROR = 0.02
"""Share to which it tells a moment of drag."""
LARGEST_PHASE_LAG = 0.02
"""s by which a phase may be off that is all wrong: a rotor's lag."""
OFFSET = 0.03
"""Standard deviation, in arms, of the centre of mass across the rotors' axes."""
START_TAUS = (0.5, 1.0, 2.0, 4.0)
"""Time constants, over the vehicle file's, from which the search sets out."""
START_LATENCIES = (0.002, 0.012)
"""s, likewise; the likeliest of their pairs."""
PRIOR = np.array([0.7, 0.7, 0.01])
"""Standard deviations of the lags' coordinates about the vehicle file's."""
BOUNDS = ((np.log(0.002), np.log(0.5)), (np.log(0.002), np.log(0.5)), (0.0, 0.06))
SIMPLEX = np.diag([0.2, 0.2, 0.003])
"""First steps of the search."""
NUDGE = (1e-2, 1e-2, 2e-4)
"""Steps of the lags' coordinates for derivatives."""
ROUNDS, CONVERGED = 5, np.array([0.02, 0.02, 5e-4])
"""Of weighing and searching, at most; steps of the lags' coordinates below which it has arrived."""


@dataclass(frozen=True)
class Response:
    """What one flight says.

    Attributes
    ----------
    lags
        Of the motors.
    gains
        Output -> the response: mass over inertia in 1/m², of torque's lever in m, or of thrust to
        squared rotor speed.
    steady
        Of `STEADY` -> rad/s².
    covariance
        (10, 10) of `NAMES`: of the lags' coordinates, the gains and what is steady.
    explained
        Output -> share of its variance that is explained, in the band of `smoothed`.
    curves
        Output -> measured and modelled (n,) there, for a picture.
    time
        (n,) s of those.
    """

    lags: Lags
    gains: Mapping[str, float]
    steady: Mapping[str, float]
    covariance: Array
    explained: Mapping[str, float]
    curves: Mapping[str, tuple[Array, Array]]
    time: Array


TINY = 1e-30
"""Size of a column that is none."""
RIDGE = 1e-12
"""What is added to the unit diagonal of normal equations, against columns that are alike."""
Tables = dict[str, list[Array]]
"""Output -> a table of each stretch."""


@dataclass(frozen=True)
class _Problem:
    """What is explained, and by what.

    Attributes
    ----------
    stretches, vehicle, motor
        What flew, as far as it is known.
    measured
        Output -> (n,) of each stretch.
    still
        Output -> (n, k) of each stretch, what explains it at any lags; the constant first.
    shared
        (n, 3) m/s² of each stretch's all steps: f_x and f_y up to `DRAG_BAND`, f_z up to
        `THRUST_BAND`.
    """

    stretches: tuple[Stretch, ...]
    vehicle: VehicleFile
    motor: Motor
    measured: Tables
    still: Tables
    shared: tuple[Array, ...]

    @property
    def step(self) -> float:
        return self.stretches[0].step

    @property
    def begin(self) -> Array:
        """The lags' coordinates (3,) in the vehicle file."""
        value = values_of(self.vehicle)
        late = value.get("actuator_latency") or 0.0
        return Lags(value["time_constant_up"], value["time_constant_down"], late).coordinates


@dataclass(frozen=True)
class _Weighing:
    """How errors of one output are weighed.

    Attributes
    ----------
    kernel
        Leaves of errors what those before do not predict, in their standard deviations.
    prior
        (k,) information about what no lag moves.
    basis, target
        Orthonormal columns (n + k, k) of that, filtered, and what it leaves of the measured.
    """

    kernel: Array
    prior: Array
    basis: Array
    target: Array

    @staticmethod
    def of(problem: _Problem, name: str, kernel: Array, gain: float | None = None) -> _Weighing:
        """Return the weighing of an output; ``gain`` of what flew, once known."""
        prior = _prior(problem, name, gain)
        table = np.vstack([_filter(problem.still[name], kernel), np.diag(np.sqrt(prior))])
        size = np.sqrt((table * table).sum(axis=0)) + TINY
        basis = np.linalg.qr(table / size)[0]
        target = np.concatenate([_filter(problem.measured[name], kernel), np.zeros(len(prior))])
        return _Weighing(kernel, prior, basis, target - basis @ (basis.T @ target))

    def left(self, moving: Sequence[Array]) -> Array:
        """Return what columns that lags move leave of the measured (n + k,)."""
        table = _filter(moving, self.kernel)
        table = np.vstack([table, np.zeros((len(self.prior), table.shape[1]))])
        table = table - self.basis @ (self.basis.T @ table)
        found = scaled_solve(table.T @ table, table.T @ self.target, RIDGE)
        return np.asarray(self.target - table @ found)

    def solved(
        self, columns: Sequence[Array], measured: Sequence[Array]
    ) -> tuple[Array, Array, Array]:
        """Return the best coefficients (k,), the filtered columns (n, k), and the errors (n,)."""
        table, seen = _filter(columns, self.kernel), _filter(measured, self.kernel)
        prior = np.zeros(table.shape[1])
        prior[-len(self.prior) :] = self.prior
        found = scaled_solve(table.T @ table + np.diag(prior), table.T @ seen, RIDGE)
        return found, table, seen - table @ found


def fit_response(stretches: tuple[Stretch, ...], vehicle: VehicleFile) -> Response:
    """Fit the lags and the gains of one flight.

    Its errors are also those of which the same at half the rate knows nothing: what noise that the
    loop did not see, or air, does to a gain is not the same at other frequencies.

    Parameters
    ----------
    stretches
        Of the flight, at least one.
    vehicle
        Of a known mass, geometry, and curve from command to rotor speed.
    """
    found = _fit(stretches, vehicle)
    other = _fit(tuple(stretch.coarser for stretch in stretches), vehicle)
    apart = _numbers(found) - _numbers(other)
    return replace(found, covariance=found.covariance + np.diag(apart**2))


def _numbers(response: Response) -> Array:
    return np.array(
        [*response.lags.coordinates, *response.gains.values(), *response.steady.values()]
    )


def _fit(stretches: tuple[Stretch, ...], vehicle: VehicleFile) -> Response:
    problem = _problem_of(stretches, vehicle)
    weighings = {name: _Weighing.of(problem, name, np.ones(1)) for name in OUTPUTS}
    place = problem.begin
    for _ in range(ROUNDS):
        weighings = _reweight(problem, place, weighings)
    for number in range(ROUNDS):
        before, place = place, _search_lags(problem, place, weighings, first=number == 0)
        for _ in range(2):
            weighings = _reweight(problem, place, weighings)
        if np.all(np.abs(place - before) < CONVERGED):
            break
    return _response(problem, place, weighings)


def _problem_of(stretches: tuple[Stretch, ...], vehicle: VehicleFile) -> _Problem:
    measured: Tables = {name: [] for name in OUTPUTS}
    still: Tables = {name: [] for name in OUTPUTS}
    shared = []
    for stretch in stretches:
        inside, step = stretch.inside[:-1], stretch.step
        rate = stretch.body_rate[:-1]
        force = 0.5 * (stretch.force[1:] + stretch.force[:-1])
        turning = (np.diff(stretch.body_rate, axis=0) / step)[inside]
        across = low_passed(force[:, :2], step, DRAG_BAND)
        shared.append(np.column_stack([across, low_passed(force[:, 2:], step, THRUST_BAND)]))
        one = np.ones(int(inside.sum()))
        for axis, name in enumerate(OUTPUTS[:3]):
            coupling = rate[:, (axis + 1) % 3] * rate[:, (axis + 2) % 3]
            columns = [one, rate[inside, axis], coupling[inside]]
            if axis < 2:
                columns += [across[inside, 1 - axis], shared[-1][inside, 2] - GRAVITY]
            measured[name].append(turning[:, axis])
            still[name].append(np.column_stack(columns))
        measured["thrust"].append(force[inside, 2])
        still["thrust"].append(one[:, None])
    motor = model_of(vehicle, ControllerFile()).vehicle.motor
    return _Problem(stretches, vehicle, motor, measured, still, tuple(shared))


def _lag_columns(problem: _Problem, place: Array) -> Tables:
    """Return for each output the columns that lags move, the gain's first."""
    vehicle, step = problem.vehicle, problem.step
    arms, places = levers(vehicle), _places(vehicle)
    height = places[:, 2].mean()
    tables: Tables = {name: [] for name in OUTPUTS}
    for stretch, shared in zip(problem.stretches, problem.shared, strict=True):
        speed = rotor_speeds(stretch.command, step, problem.motor, Lags.at(place))
        inside = stretch.inside[:-1]
        square = 0.5 * (speed[1:] ** 2 + speed[:-1] ** 2)
        lift, torque = square.sum(axis=1), square @ arms
        each = shared[:, 2] / low_passed(lift[:, None], step, THRUST_BAND)[:, 0]
        mean = (speed[1:] + speed[:-1]) @ places / (speed[1:] + speed[:-1]).sum(axis=1)[:, None]
        spread = mean[:, 0] * shared[:, 1] - mean[:, 1] * shared[:, 0]
        reaction = np.diff(speed @ np.sign(arms[:, 2])) / step
        since = stretch.time[:-1] - stretch.time.mean()
        tables["roll"].append((each * torque[:, 0] - height * shared[:, 1])[inside, None])
        tables["pitch"].append((each * torque[:, 1] + height * shared[:, 0])[inside, None])
        tables["yaw"].append(np.column_stack([torque[:, 2], reaction, spread])[inside])
        tables["thrust"].append(np.column_stack([lift, since * lift])[inside])
    return tables


def _places(vehicle: VehicleFile) -> Array:
    """Return (4, 3) m of the rotors from the centre of mass."""
    value, places = values_of(vehicle), np.array([rotor.position for rotor in vehicle.rotors])
    return np.asarray(places - [value.get(f"center_of_mass_{axis}") or 0.0 for axis in "xyz"])


def _prior(problem: _Problem, name: str, gain: float | None) -> Array:
    """Return the information (k,) about what no lag moves; ``gain`` of what flew, once known."""
    prior = np.zeros(problem.still[name][0].shape[1])
    value = values_of(problem.vehicle)
    if name == "thrust":
        prior[CONSTANT] = BIAS**-2
    elif name != "yaw":
        axis = OUTPUTS.index(name)
        if gain is None or gain <= 0.0:
            gain = value["mass"] / value[("inertia_xx", "inertia_yy")[axis]]
        arm = np.abs(levers(problem.vehicle)[:, axis]).max()
        prior[-2:] = (HEIGHT * arm * gain) ** -2, (OFFSET * arm * gain) ** -2
    return prior


def _filter(tables: Sequence[Array], kernel: Array) -> Array:
    """Return the rows (n, k) of all stretches, filtered; the first that a filter spans are lost."""
    shape = (-1, *(1,) * (tables[0].ndim - 1))
    parts = [
        signal.oaconvolve(table, kernel.reshape(shape), "valid", axes=0)
        for table in tables
        if len(table) >= len(kernel)
    ]
    return np.concatenate(parts)


def _columns(problem: _Problem, name: str, moving: Tables) -> list[Array]:
    pairs = zip(moving[name], problem.still[name], strict=True)
    return [np.hstack(pair) for pair in pairs]


def _reweight(
    problem: _Problem, place: Array, weighings: Mapping[str, _Weighing]
) -> dict[str, _Weighing]:
    """Return the weighings that errors at a place call for."""
    moving, order = _lag_columns(problem, place), max(1, round(NOISE_MEMORY / problem.step))
    renewed = {}
    for name in OUTPUTS:
        columns, measured = _columns(problem, name, moving), problem.measured[name]
        found, *_ = weighings[name].solved(columns, measured)
        alike = np.zeros(order + 1)
        for table, values in zip(columns, measured, strict=True):
            errors = values - table @ found
            errors = errors - errors.mean()
            both = signal.correlate(errors, errors, "full", method="fft")
            alike += both[len(errors) - 1 :][: order + 1]
        alike /= sum(map(len, measured))
        if name == "thrust":
            alike[0] += ACCELEROMETER**2
        else:
            alike[:2] += np.array([2.0, -1.0]) * (GYRO / problem.step) ** 2
        ahead = linalg.solve_toeplitz(alike[:-1], alike[1:])
        new = np.sqrt(max(alike[0] - ahead @ alike[1:], 1e-300))
        kernel = np.concatenate([[1.0], -ahead]) / new
        renewed[name] = _Weighing.of(problem, name, kernel, float(found[0]))
    return renewed


def _search_lags(
    problem: _Problem, place: Array, weighings: Mapping[str, _Weighing], *, first: bool
) -> Array:
    """Return the likeliest lags' coordinates (3,)."""
    begin = problem.begin

    def misfit(at: Array) -> float:
        moving, total = _lag_columns(problem, at), float(np.sum(((at - begin) / PRIOR) ** 2))
        for name in OUTPUTS:
            left = weighings[name].left(moving[name])
            total += len(left) * float(np.log(np.mean(left * left) + TINY))
        return total

    if first:
        others = [
            np.array([*(begin[:2] + np.log(factor)), late])
            for factor in START_TAUS
            for late in START_LATENCIES
        ]
        place = min([place, *others], key=misfit)
    end = optimize.minimize(
        misfit,
        place,
        method="Nelder-Mead",
        bounds=BOUNDS,
        options={
            "initial_simplex": np.vstack([place, place + SIMPLEX]),
            "xatol": 3e-3,
            "fatol": 0.1,
            "maxfev": 80,
        },
    )
    return np.asarray(end.x)


def _response(problem: _Problem, place: Array, weighings: Mapping[str, _Weighing]) -> Response:
    """Return what is found at a place, and how surely."""
    moving, slopes = _lag_columns(problem, place), _slopes(problem, place)
    found, tables, errors, curves = {}, {}, {}, {}
    for name in OUTPUTS:
        weighing, columns = weighings[name], _columns(problem, name, moving)
        found[name], table, errors[name] = weighing.solved(columns, problem.measured[name])
        gains = found[name][: moving[name][0].shape[1]]
        by_lags = [_filter([part @ gains for part in s[name]], weighing.kernel) for s in slopes]
        tables[name] = np.column_stack([*by_lags, table])
        modelled = [table @ found[name] for table in columns]
        seen, made = (
            np.concatenate([smoothed(part[:, None], problem.step)[:, 0] for part in parts])
            for parts in (problem.measured[name], modelled)
        )
        curves[name] = seen, made
    covariance = _covariance(problem, weighings, tables, errors)
    covariance += _air_covariance(problem, moving, found)
    return Response(
        lags=Lags.at(place),
        gains={name: float(solution[0]) for name, solution in found.items()},
        steady={
            name: float(found[output][moving[output][0].shape[1] + CONSTANT])
            for name, output in zip(STEADY, OUTPUTS, strict=False)
        },
        covariance=covariance,
        explained={
            name: float((np.var(seen) - np.var(seen - made)) / (np.var(seen) + BIAS**2))
            for name, (seen, made) in curves.items()
        },
        curves=curves,
        time=np.concatenate([s.time[:-1][s.inside[:-1]] for s in problem.stretches]),
    )


def _slopes(problem: _Problem, place: Array) -> list[Tables]:
    """Return the derivatives of the moving columns by each of the lags' coordinates."""
    slopes = []
    for number, nudge in enumerate(NUDGE):
        ends = np.array([place, place])
        ends[:, number] = np.clip(place[number] + nudge * np.array([1.0, -1.0]), *BOUNDS[number])
        span = ends[0, number] - ends[1, number]
        high, low = (_lag_columns(problem, end) for end in ends)
        slopes.append(
            {
                name: [(a - b) / span for a, b in zip(high[name], low[name], strict=True)]
                for name in OUTPUTS
            }
        )
    return slopes


def _covariance(
    problem: _Problem,
    weighings: Mapping[str, _Weighing],
    tables: Mapping[str, Array],
    errors: Mapping[str, Array],
) -> Array:
    """Return the covariance of the numbers (10, 10).

    Of what is new in errors, or of how blocks of them scatter (sandwich): the larger of both.
    """
    order = len(weighings["roll"].kernel) - 1
    blocks = blocks_of(problem.stretches, order)
    total = 3 + sum(tables[name].shape[1] - 3 for name in OUTPUTS)
    bread, scores = np.zeros((total, total)), np.zeros((int(blocks.max()) + 1, total))
    bread[:3, :3] = np.diag(PRIOR**-2)
    first, gains, constants = 3, [], []
    for name in OUTPUTS:
        table = tables[name]
        moved = table.shape[1] - 3 - len(weighings[name].prior)
        places = np.r_[0:3, first : first + table.shape[1] - 3]
        bread[np.ix_(places, places)] += table.T @ table
        still = places[3 + moved :]
        bread[still, still] += weighings[name].prior
        np.add.at(scores, (blocks[:, None], places[None]), table * errors[name][:, None])
        gains.append(first)
        constants.append(first + moved + CONSTANT)
        first += table.shape[1] - 3
    nothing = np.zeros_like(bread)
    inverse = Inverse.of(bread, nothing)
    count, most = len(scores), max(table.shape[1] for table in tables.values())
    scattered = inverse.sandwiched(scores.T @ scores, nothing) * (count / max(1, count - most))
    white = inverse.sandwiched(bread, nothing)
    wider = np.sqrt(np.maximum(1.0, np.diag(white) / np.maximum(np.diag(scattered), 1e-300)))
    covariance = scattered * np.outer(wider, wider) + inverse.open
    wanted = [0, 1, 2, *gains, *constants[:3]]
    return np.asarray(covariance[np.ix_(wanted, wanted)])


def _air_covariance(problem: _Problem, moving: Tables, found: Mapping[str, Array]) -> Array:
    """Return the covariance (10, 10) of what the accelerometer does not tell of air.

    What air takes of the thrust is not known in the mean: as much, say, as it changes along the
    flight, or as the constant is that it leaves of the specific force. Whether it takes it of a
    rotor's speed or of its square, and the accelerometer's own error along z, make up as much of
    roll's and pitch's gain. The moment of drag is known to a share (`DRAG_MOMENT_ERROR`), which is
    more of the turning the gentler that is. What the axial airspeed takes of rotors that rise or
    sink as the vehicle turns damps that, or drives it where the air comes from below: half of that
    is unknown.
    A phase that is off by as much is another lag.
    """
    gain, decline = found["thrust"][:2]
    left = []
    for stretch, shared, table in zip(
        problem.stretches, problem.shared, moving["thrust"], strict=True
    ):
        lift = low_passed(table, problem.step, THRUST_BAND) @ [gain, decline]
        left.append(shared[stretch.inside[:-1], 2] / lift)
    taken = float(np.concatenate(left).std())
    fastest = min(problem.vehicle.aerodynamics.max_relative_airspeed, AIRSPEED)
    shares = []
    for name in OUTPUTS[:2]:
        turned = np.concatenate(
            [smoothed(m[:, None], problem.step) for m in problem.measured[name]]
        )
        force = np.concatenate([still[:, DRAG] for still in problem.still[name]])
        arm = abs(float(_places(problem.vehicle)[:, 2].mean())) * abs(found[name][0])
        told = DRAG_MOMENT_ERROR * arm * force.std()
        turning = turned.std() + GYRO
        rate = np.concatenate([still[:, RATE] for still in problem.still[name]]).std()
        squares = np.mean(levers(problem.vehicle)[:, OUTPUTS.index(name)] ** 2)
        damped = 0.5 * abs(found[name][0]) * GRAVITY * squares / fastest * rate
        told = np.hypot(told, damped) / turning
        shares.append(float(np.sqrt(taken**2 + (BIAS / GRAVITY) ** 2 + told**2)))
    both = float(np.mean(shares))
    deviations = np.zeros(len(NAMES))
    deviations[:3] = both, both, both * LARGEST_PHASE_LAG
    deviations[3:5] = np.abs([found[name][0] for name in OUTPUTS[:2]]) * shares
    offset = found["thrust"][moving["thrust"][0].shape[1] + CONSTANT] / GRAVITY
    deviations[-len(STEADY) :] = TRIM_VARIATION
    deviations[NAMES.index("thrust")] = gain * np.hypot(taken, offset)
    return np.diag(deviations**2)
