"""A result folder that nothing was simulated or fitted for: numbers such as a run would leave."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from tuner.core.shipped import find_config
from tuner.design.proposals import LogProposal
from tuner.evaluate.closed_loop import Forces
from tuner.evaluate.comparison import FlightErrors, SignalErrors, table_of
from tuner.evaluate.records import PredictedErrors
from tuner.report import write_traces
from tuner.report.contents import SearchRecord
from tuner.result import (
    CoefficientResult,
    EffectiveResult,
    Ending,
    FlightResult,
    LostTerm,
    PoseRmse,
    RunResult,
    SearchResult,
    Status,
)
from tuner.search.listener import Iteration, Outcome
from tuner.uncertainty.records import (
    CoefficientKnowledge,
    EffectOverTime,
    Knowledge,
    OutputSensitivity,
    Residual,
)
from tuner.uncertainty.verdict import (
    NOT_FITTED,
    Direction,
    Reason,
    ReasonCode,
    Verdict,
    judge,
    judgement_in_words,
)
from tuner.vehicle import (
    COEFFICIENTS,
    VehicleFile,
    read_vehicle,
    values_of,
    with_values,
    write_vehicle,
)
from tuner.vehicle.selection_table import SelectionCode, SelectionRow

COMMAND = "tune --flights 'lab/*.bag' </script><b>"
FLIGHTS = ("swing", "spin")
CHANNELS = {"position": ("m", "xyz"), "attitude": ("deg", ("roll", "pitch", "yaw"))}
SECONDS = 6.0


def write_run(folder: Path, free: Sequence[str], undetermined: Direction) -> None:
    """Write what a run would write whose flights do not determine one direction."""
    vehicle = read_vehicle(find_config("vehicles", "hovergames", Path()))
    write_vehicle(vehicle, folder / "best_fit.yaml", header="A test's.")
    initial = {name: _errors(0.2) for name in FLIGHTS}
    best = {name: _errors(0.002) for name in FLIGHTS}
    simulations = {"initial": initial, "best": best}
    table_of(simulations).write(folder)
    write_traces(folder, simulations)
    values = values_of(vehicle)
    SearchRecord(
        iterations=[
            Iteration(
                stage="whole flights",
                number=n,
                loss=10.0**-n,
                position_rmse=0.1**n,
                accepted=True,
                horizon=6.0,
                damping=10.0**-n,
            )
            for n in range(4)
        ],
        starts=[
            Outcome(origin="vehicle file", loss=0.5, start=values, end=values),
            Outcome(origin="random", loss=3.0, start=values, end=values),
            Outcome(origin="random", loss=None, start=values, end=values),
        ],
    ).write(folder)
    knowledge = _knowledge(vehicle, free, undetermined)
    knowledge.write(folder)
    result = _result(vehicle, knowledge, initial, best)
    assert result.effective is not None
    in_gazebo = with_values(vehicle, result.effective.coefficients)
    write_vehicle(in_gazebo, folder / "effective.yaml", header="A test's.")
    result.write(folder)


def _errors(size: float) -> FlightErrors:
    time = np.linspace(0.0, SECONDS, 300)
    recorded = np.column_stack([np.sin(2.2 * time), np.sin(3.1 * time), 1.0 + 0.1 * time])
    error = size * np.column_stack([np.sin(time), np.cos(time), 0.1 * time])
    position = SignalErrors(time, recorded, error)
    attitude = SignalErrors(time, 10 * recorded, 10 * error)
    thrust, drag = np.zeros((300, 6)), np.zeros((300, 6))
    thrust[:, 2], drag[:, 0], drag[:, 4] = 22.0, np.sin(time), 0.06 * np.sin(time)
    forces = Forces(time, {"thrust": thrust, "rotor_drag": drag, "gravity": -thrust})
    return FlightErrors(position, attitude, np.array([2.0, 4.0]), None, forces)


def _knowledge(vehicle: VehicleFile, free: Sequence[str], undetermined: Direction) -> Knowledge:
    values = values_of(vehicle)
    names = [*free, *(name for name in values if name not in free)]
    size = len(free)
    time = np.linspace(0.1, SECONDS - 0.1, 20)
    rising, faint = (time / SECONDS).tolist(), dict.fromkeys(names, 0.01)
    lags = np.arange(30)
    apart = np.abs(np.subtract.outer(np.arange(size), np.arange(size)))
    return Knowledge(
        coefficients={
            name: _known(name, values[name], undetermined, fitted=name in free) for name in names
        },
        flights=list(FLIGHTS),
        channels=list(CHANNELS),
        outputs=[
            OutputSensitivity(
                flight=flight,
                channel=channel,
                axis=axis,
                unit=unit,
                rmse=0.002,
                change=faint,
                rmse_up=faint,
                rmse_down=faint | {"motor_constant": None},
            )
            for flight in FLIGHTS
            for channel, (unit, axes) in CHANNELS.items()
            for axis in axes
        ],
        effects_over_time=[
            EffectOverTime(
                flight=flight,
                time=time.tolist(),
                change=dict.fromkeys(names, rising),
                span=dict.fromkeys(names, (4.0, 6.0)),
            )
            for flight in FLIGHTS
        ],
        residuals=[
            Residual(
                flight=flight,
                channel=channel,
                rms=1.0,
                spacing=0.02,
                autocorrelation=(0.5**lags).tolist(),
                limit=0.1,
                memory=0.03,
                white=False,
            )
            for flight in FLIGHTS
            for channel in CHANNELS
        ],
        directions=[undetermined],
        names=list(free),
        correlation=(0.5**apart).tolist(),
        covariance=np.eye(size).tolist(),
        information=np.eye(size).tolist(),
    )


def _known(
    name: str, value: float, undetermined: Direction, *, fitted: bool
) -> CoefficientKnowledge:
    open_ended = name in undetermined.moves
    error = 0.01 * (abs(value) or 1.0)
    prior_share = 0.98 if open_ended else 0.02
    known = Reason(
        code=ReasonCode.INTERVAL,
        half_width=0.02,
        prior_share=prior_share,
        prior_given=False,
        channel="position",
    )
    verdict, reason = judge(
        name,
        known,
        [undetermined],
        relative_half_width=0.02,
        data_error=undetermined.error if open_ended else 0.01,
    )
    share = (1.0 - prior_share) / (len(CHANNELS) * len(FLIGHTS))
    return CoefficientKnowledge(
        unit=COEFFICIENTS[name].unit,
        fitted=fitted,
        value=value,
        std_error=error,
        ci95=(value - 2 * error, value + 2 * error),
        verdict=verdict,
        reason=reason,
        step=abs(value) or 1.0,
        shares={channel: dict.fromkeys(FLIGHTS, share) for channel in CHANNELS},
        prior_share=prior_share,
        bias={} if fitted else {"motor_constant": 0.2},
    )


def _result(
    vehicle: VehicleFile,
    knowledge: Knowledge,
    initial: Mapping[str, FlightErrors],
    best: Mapping[str, FlightErrors],
) -> RunResult:
    coefficients = {}
    for name, value in values_of(vehicle).items():
        known = knowledge.coefficients[name]
        judged = (known.verdict, known.reason) if known.fitted else (Verdict.FIXED, NOT_FITTED)
        coefficients[name] = CoefficientResult(
            unit=known.unit,
            initial=1.1 * value if known.fitted else value,
            best=value,
            fitted=known.fitted,
            std_error=known.std_error if known.fitted else None,
            ci95=known.ci95 if known.fitted else None,
            identifiable=known.reason.identifiable if known.fitted else None,
            verdict=judged[0],
            reason=judged[1],
            note=judgement_in_words(*judged),
        )
    flights = tuple(
        FlightResult(
            name=name,
            path=f"lab/{name}.bag",
            sha256="ab" * 32,
            split="fit" if number == 0 else "holdout",
            duration=SECONDS,
            time_offset=0.0,
            rmse_initial=initial[name].rmse,
            rmse_best=best[name].rmse,
            predicted_initial=(_ahead(3.0),),
            predicted_best=(_ahead(1.25),),
            predicted_with_observer=(_ahead(1.0),),
            predicted_holding=(_ahead(0.75),),
        )
        for number, name in enumerate(FLIGHTS)
    )
    drag = {name: 1.2 * result.best for name, result in coefficients.items() if "drag" in name}
    return RunResult(
        effective=EffectiveResult(
            target="gazebo",
            coefficients={name: result.best for name, result in coefficients.items()} | drag,
            lost=(
                LostTerm(
                    group="fuselage_drag",
                    names=("fuselage_drag",),
                    rmse_without=PoseRmse(position=0.03, attitude=None),
                ),
            ),
            carried=("center_of_mass_x",),
            rmse_physical=PoseRmse(position=0.002, attitude=0.1),
            rmse_unfitted=PoseRmse(position=0.04, attitude=0.5),
            rmse_effective=PoseRmse(position=0.012, attitude=0.3),
            flights={name: best[name].rmse for name in FLIGHTS},
            converged=True,
        ),
        schema_version=2,
        status=Status.CONVERGED,
        seed=7,
        versions={"multirotor-tune": "0.1.0"},
        settings={"command": COMMAND, "origin": {"mass": "--mass"}, "vehicle": {"name": "quad"}},
        coefficients=coefficients,
        flights=flights,
        findings=(),
        selection=(
            SelectionRow(
                group="fuselage_drag",
                names=("fuselage_drag",),
                gain_fit=0.3,
                gain_holdout=0.28,
                scatter=0.04,
                kept=True,
                reason=SelectionCode.PREDICTS_FLIGHTS,
            ),
            SelectionRow(
                group="ground_effect",
                names=("ground_effect",),
                gain_fit=1e-5,
                gain_holdout=-0.001,
                scatter=0.002,
                kept=False,
                reason=SelectionCode.IMMATERIAL,
            ),
        ),
        next_log=(
            LogProposal(signal="command", change="faster", rate=200.0, shrinks={"mass": 0.7}),
        ),
        search=SearchResult(
            method="gradient",
            evaluations=9,
            iterations=4,
            wall_time=1.0,
            cost_initial=10.0,
            cost_best=0.5,
            converged=True,
            message=Ending.NO_FURTHER_GAIN,
        ),
    )


def _ahead(rate):
    return PredictedErrors(seconds=0.5, position=None, velocity=None, attitude=None, body_rate=rate)
