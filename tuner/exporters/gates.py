"""The gates of an export: conditions that a run must meet."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from tuner.core.errors import InputError
from tuner.evaluate.records import RMSE_UNITS, AxesRmse
from tuner.exporters.simulators import hover_command, thrust_to_weight
from tuner.exporters.target import Draft
from tuner.result import Gate, Run
from tuner.vehicle import VehicleFile

#: Simulates all flights of a run with a vehicle -> flight name -> RMSE, None for a crash.
Refly = Callable[[Run, VehicleFile], Mapping[str, AxesRmse]]

#: Share of the distance between bounds within which a coefficient is on one.
BOUND_TOLERANCE = 1e-4
#: Share by which the RMSE of a flight that checks the run may grow in the fit.
MAX_RMSE_INCREASE = 0.01
#: Equal RMSEs differ by less, relatively or in m and degrees.
RELATIVE_TOLERANCE, ABSOLUTE_TOLERANCE = 0.01, 1e-4
#: The RMSE in the target's simulator may exceed that of this project's by a factor and an offset.
MAX_RMSE_RATIO, RMSE_SLACK_M, RMSE_SLACK_DEG = 2.0, 0.02, 2.0
#: Hover throttles, 0..1, may differ by this.
THROTTLE_TOLERANCE = 0.005

#: The conditions of a run.
RUN_CONDITIONS = (
    "every trajectory of the run is flown without a crash",
    "the exported numbers fly as the run says",
    "no flight that checks the run is worse than before",
    "no coefficient sits on a bound",
)


def check(run: Run, vehicle: VehicleFile, refly: Refly) -> tuple[Gate, ...]:
    """Check a run and the vehicle as exported against every condition."""
    if not run.result.flights:
        return (*gates_not_run()[:-1], Gate(RUN_CONDITIONS[-1], tuple(_on_bounds(run))))
    try:
        flown = refly(run, vehicle)
        differing = _differing(run, flown)
    except InputError as error:
        flown, differing = {}, [f"the flights cannot be flown again ({error})"]
    objections = (_crashes(flown), differing, _worse_flights(run), _on_bounds(run))
    return tuple(Gate(name, tuple(o)) for name, o in zip(RUN_CONDITIONS, objections, strict=True))


def check_in_simulator(
    run: Run, draft: Draft, refly: Callable[..., Mapping[str, AxesRmse]], title: str
) -> tuple[Gate, str]:
    """Check an export by flying it in its own, installed, simulator.

    Returns the gate, and a sentence on the RMSEs there.
    """
    there = refly(run, draft.vehicle, draft.flier)
    objections = list(_crashes(there))
    for flight in run.result.flights:
        own, other = flight.rmse_best, there[flight.name]
        for signal, slack, unit in (
            ("position", RMSE_SLACK_M, "m"),
            ("attitude", RMSE_SLACK_DEG, "deg"),
        ):
            expected, found = own.norm(signal), other.norm(signal)
            if math.isfinite(found) and found > expected * MAX_RMSE_RATIO + slack:
                objections.append(
                    f"{flight.name} is missed by {found:.3g} {unit}, expected {expected:.3g}"
                )
    missed = "; ".join(
        f"{name} {1000 * rmse.norm('position'):.3g} mm, {rmse.norm('attitude'):.2g}°"
        for name, rmse in there.items()
    )
    return Gate(f"{title} itself flies it so", tuple(objections)), f"flown in {title}: {missed}"


def gates_not_run() -> tuple[Gate, ...]:
    """Return the conditions of a run, for a vehicle without one."""
    return tuple(Gate(name, (), ran=False) for name in RUN_CONDITIONS)


def check_hover(wanted: VehicleFile, there: VehicleFile) -> Gate:
    """Check an export by thrust and hover, which need no flight.

    Parameters
    ----------
    wanted
        The vehicle that the simulator should fly.
    there
        The vehicle that it flies with the written file.
    """
    objections = []
    ratio, expected = thrust_to_weight(there), thrust_to_weight(wanted)
    if not math.isclose(ratio, expected, rel_tol=RELATIVE_TOLERANCE):
        objections.append(f"full thrust is {ratio:.3g} times the weight, should be {expected:.3g}")
    hover, wanted_hover = hover_command(there), hover_command(wanted)
    if hover is None:
        objections.append(f"it cannot hover, its full thrust is {ratio:.3g} times its weight")
    elif wanted_hover is None or abs(hover - wanted_hover) > THROTTLE_TOLERANCE:
        should = "none at all" if wanted_hover is None else f"{wanted_hover:.3f}"
        objections.append(f"it hovers at a throttle of {hover:.3f}, should be {should}")
    return Gate("thrust to weight and hover throttle are the vehicle's", tuple(objections))


def _crashes(flown: Mapping[str, AxesRmse]) -> list[str]:
    return [_crash(name) for name, rmse in flown.items() if rmse.x is None]


def _crash(flight: str) -> str:
    return f"{flight} crashes"


def _differing(run: Run, flown: Mapping[str, AxesRmse]) -> list[str]:
    objections = []
    for flight in run.result.flights:
        again = flown.get(flight.name)
        if again is None:
            objections.append(f"{flight.name} was not flown again")
            continue
        for axis in RMSE_UNITS:
            then, now = getattr(flight.rmse_best, axis), getattr(again, axis)
            if then is None or now is None:
                continue
            if not math.isclose(then, now, rel_tol=RELATIVE_TOLERANCE, abs_tol=ABSOLUTE_TOLERANCE):
                objections.append(f"{flight.name} {axis} gives {now:.4g}, the run {then:.4g}")
    return objections


def _worse_flights(run: Run) -> list[str]:
    objections, flights = [], run.result.flights
    for flight in [one for one in flights if one.split == "holdout"] or flights:
        for what, unit in (("position", "m"), ("attitude", "degrees")):
            before, after = (flight.rmse_initial.norm(what), flight.rmse_best.norm(what))
            if math.isinf(after):
                objections.append(_crash(flight.name))
                break
            if after > before * (1 + MAX_RMSE_INCREASE) + ABSOLUTE_TOLERANCE:
                objections.append(f"{flight.name} {what} {after:.4g} {unit}, before {before:.4g}")
    return objections


def _on_bounds(run: Run) -> list[str]:
    """Return the coefficients on bounds that flights tell, and that are not zero there.

    The others move no flight: notes of the export name them.
    """
    objections = []
    for name, coefficient in run.result.coefficients.items():
        lower, upper = coefficient.lower, coefficient.upper
        if not coefficient.fitted or coefficient.identifiable is False:
            continue
        span = upper - lower if lower is not None and upper is not None else None
        for side, bound in (("lower", lower), ("upper", upper)):
            near = BOUND_TOLERANCE * (abs(bound or 0.0) if span is None else span)
            if bound is None or abs(coefficient.initial - bound) <= near:
                continue  # the search began there: a set-up without a delay has a latency of zero
            if bound != 0.0 and abs(coefficient.best - bound) <= near:
                objections.append(f"{name} {coefficient.best:g} is its {side} bound")
    return objections
