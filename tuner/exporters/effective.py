"""Which of a run's two answers leaves it: physical coefficients, or those effective in Gazebo."""

from __future__ import annotations

from tuner.coefficients import REGISTRY, Written
from tuner.exporters.target import Target
from tuner.result import Run


def in_simulator(run: Run, target: Target) -> Run:
    """Return a run as a target flies it: with its second answer in the place of the first.

    The run itself where both are the same, where the target has a place for all that Gazebo lacks,
    and where the job wants physical coefficients.
    """
    effective, flying = run.result.effective, run.effective
    if effective is None or flying is None or _wanted(run) == "physical":
        return run
    lost = {name for term in effective.lost for name in term.names}
    if all(isinstance(target.entry(REGISTRY[name]), Written) for name in lost):
        return run
    coefficients = {
        name: row.model_copy(update={"best": effective.coefficients[name]})
        for name, row in run.result.coefficients.items()
        if name in effective.coefficients
    }
    flights = tuple(
        flight.model_copy(
            update={
                "rmse_best": effective.flights[flight.name],
                "conditions": {n: v for n, v in flight.conditions.items() if n not in lost},
            }
        )
        for flight in run.result.flights
    )
    result = run.result.model_copy(update={"coefficients": coefficients, "flights": flights})
    return run.model_copy(update={"vehicle": flying, "result": result})


def _wanted(run: Run) -> str:
    job = run.result.settings.get("job")
    return str(job.get("target", "gazebo")) if isinstance(job, dict) else "gazebo"
