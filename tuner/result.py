"""The result of a run, as ``result.json`` and ``best_fit.yaml`` hold it in the result folder."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, JsonValue, field_serializer, field_validator
from pydantic_core import from_json

from tuner.core.disk import check_links, exists, folder_for, inside, read_bytes, remove_file
from tuner.core.errors import InputError, OutputError
from tuner.core.files import MAX_BYTES, FiniteOrNone, Part, ResultFile
from tuner.core.phrases import metres
from tuner.core.yaml_section import refuse
from tuner.design.proposals import LogProposal
from tuner.evaluate.records import AxesRmse, PredictedErrors
from tuner.findings.findings import Finding, one_line
from tuner.uncertainty.records import Sources
from tuner.uncertainty.verdict import ErrorParts, Reason, Verdict, judgement_in_words
from tuner.vehicle import COEFFICIENTS, VehicleFile, read_vehicle, values_of
from tuner.vehicle.selection_table import SelectionRow

EXPORTS = "export"
"""Folder of a result folder, for its exports."""
EFFECTIVE, PLOTS = "effective", "plots"
"""Folders of a result folder: vehicles for other simulators, and figures."""
BEST_FIT_FILE = "best_fit.yaml"
EFFECTIVE_FILE = "effective.yaml"
CHECKPOINTS = "checkpoint*.npz"
OF_A_RUN = (
    BEST_FIT_FILE, EFFECTIVE_FILE, "controller.yaml", "report.html", "traces.npz",
    *(f"{name}.json" for name in ("about", "bench", "exports", "laps", "result", "search")),
    *(f"{name}.csv" for name in ("bootstrap", "cross_validation", "information_shares", "metrics")),
    *(f"{name}.csv" for name in ("correlation", "covariance", "information")),
    *(
        f"{name}.{suffix}"
        for name in ("global_sensitivity", "next_flight", "profile", "profiles", "sensitivity")
        for suffix in ("csv", "json")
    ),
)  # fmt: skip
"""Files of a result folder beside checkpoints: those that one run or another writes there."""
IN_FOLDER = (*OF_A_RUN, EXPORTS, EFFECTIVE, PLOTS)
"""Files and folders of a result folder."""
REMEDY = "give the result folder of a finished run, made by this version of tune (or run it again)"


class Status(StrEnum):
    """How a run ended."""

    CONVERGED = "converged"
    STOPPED = "stopped"


class Ending(StrEnum):
    """Why a search stopped."""

    NO_FURTHER_GAIN = "no_further_gain"
    ITERATION_LIMIT = "iteration_limit"


class CoefficientResult(Part):
    """One coefficient: its initial and best value, how well it is known, and why.

    Attributes
    ----------
    unit
        As in the registry of coefficients.
    initial, best
        Values.
    fitted
        Whether the search moved it.
    lower, upper
        Bounds of the search; None where there were none.
    std_error, ci95
        Standard error and 95 % interval; None where it was not fitted or they are not finite.
    std_error_parts
        What the standard error is made of, each part in the coefficient's unit.
    identifiable
        Whether the flights determine it; None where it was not fitted.
    jackknife_error, bootstrap_error
        Standard errors by refits with each flight left out in turn, and to flights drawn with
        replacement; None where it was not asked for.
    verdict, reason
        How well it is known, and the code and numbers behind that.
    note
        Both as a phrase for people; nothing reads it back.
    """

    unit: str
    initial: float
    best: float
    fitted: bool
    lower: float | None = None
    upper: float | None = None
    std_error: FiniteOrNone = None
    std_error_parts: ErrorParts | None = None
    ci95: tuple[float, float] | None = None
    identifiable: bool | None = None
    jackknife_error: FiniteOrNone = None
    bootstrap_error: FiniteOrNone = None
    verdict: Verdict
    reason: Reason
    note: str = ""

    @classmethod
    def judged(
        cls, name: str, initial: float, best: float, verdict: Verdict, reason: Reason, **more: Any
    ) -> Self:
        """Return a coefficient with a verdict on it, and what follows from that."""
        given: dict[str, Any] = {
            "unit": COEFFICIENTS[name].unit,
            "fitted": verdict is not Verdict.FIXED,
            "note": judgement_in_words(verdict, reason),
        }
        return cls(initial=initial, best=best, verdict=verdict, reason=reason, **given | more)

    @field_serializer("reason")
    def _without_nulls(self, reason: Reason) -> dict[str, JsonValue]:
        return reason.model_dump(mode="json", exclude_none=True)


class FlightResult(Part):
    """One recording: what it was used for and how closely it is met.

    Every simulation behind ``rmse_initial`` and ``rmse_best`` begins at a recorded state.

    Attributes
    ----------
    duration
        s.
    time_offset
        s by which its clock is late.
    clock
        Whether that was ``given``, ``fitted`` to this flight, or ``assumed`` to be zero: a held-out
        flight's is never fitted.
    conditions
        What surrounded it, of the registry's scope ``flight``, as it was simulated; of a held-out
        flight the mean of the fitted ones.
    input_late
        s by which what is fed in is stamped later than the recorded state; of a held-out flight the
        mean of the fitted ones.
    horizon
        s that each simulation lasts before the next begins at the recorded state; None for a flight
        that is simulated whole in its closed loop.
    rmse_initial, rmse_best
        With the initial and the best coefficients.
    rmse_fitted_starts
        With the best coefficients where each window's start and trim are fitted to the window: how
        well it can be met, not how well it is predicted. None for a flight simulated whole.
    predicted_initial, predicted_best, predicted_holding
        Open-loop predictions with the initial and the best coefficients, and that the state stays
        as it is, by how far they look ahead; empty for a flight simulated whole.
    predicted_with_observer
        As ``predicted_best``, with the torque besides that the last samples before a prediction
        tell and its inputs do not; empty where neither rotor speeds nor commands are fed in.
    """

    name: str
    path: str
    sha256: str
    split: Literal["fit", "holdout"]
    duration: float
    time_offset: float
    conditions: dict[str, float] = Field(default_factory=dict)
    rmse_initial: AxesRmse
    rmse_best: AxesRmse
    clock: Literal["given", "fitted", "assumed"] = "assumed"
    input_late: float = 0.0
    horizon: float | None = None
    rmse_fitted_starts: AxesRmse | None = None
    predicted_initial: tuple[PredictedErrors, ...] = ()
    predicted_best: tuple[PredictedErrors, ...] = ()
    predicted_with_observer: tuple[PredictedErrors, ...] = ()
    predicted_holding: tuple[PredictedErrors, ...] = ()


class SearchResult(Part):
    """How the minimum was found; ``wall_time`` in s, ``message`` says why it stopped."""

    method: str
    evaluations: int
    iterations: int
    wall_time: float
    cost_initial: FiniteOrNone
    cost_best: FiniteOrNone
    converged: bool
    message: Ending


class PoseRmse(Part):
    """Over all flights of a run, free yaw spins apart, the root mean square of a flight's RMSE.

    The distance in position (m), and roll, pitch and yaw together (deg); None where one crashed.
    """

    position: FiniteOrNone
    attitude: FiniteOrNone

    @property
    def words(self) -> str:
        """Both with readable units; an attitude that is an input has none."""
        if self.position is None:
            return "a crash"
        if self.attitude is None:
            return metres(self.position)
        return f"{metres(self.position)} and {self.attitude:.2g}°"


class LostTerm(Part):
    """A group of terms that the target simulator lacks, and the RMSE where it alone is missing."""

    group: str
    names: tuple[str, ...]
    rmse_without: PoseRmse


class EffectiveResult(Part):
    """The second answer: with which coefficients the target simulator flies most like the vehicle.

    Those of its own model, fitted by least squares from the physical ones, the first answer, to the
    same flights. Terms that it has a place for stay as they are, and so does what belongs to the
    set-up: latencies, clocks, markers, wind.

    Attributes
    ----------
    target
        The simulator.
    coefficients
        Name -> value of all that flies there; `effective.yaml` is the vehicle.
    lost
        What it lacks, of what acts in the physical answer.
    carried
        What of the terms beyond its motor model it has a place for, as in the first answer.
    rmse_physical
        Of the physical answer, all terms in it.
    rmse_unfitted
        Of the physical coefficients without the terms that are lost.
    rmse_effective
        Of the effective coefficients.
    flights
        Flight -> RMSE with the effective coefficients.
    converged
        Whether the fit stopped because its steps gained nothing, not at its limit.
    """

    target: str
    coefficients: dict[str, float]
    lost: tuple[LostTerm, ...]
    carried: tuple[str, ...]
    rmse_physical: PoseRmse
    rmse_unfitted: PoseRmse
    rmse_effective: PoseRmse
    flights: dict[str, AxesRmse]
    converged: bool


class RunResult(ResultFile):
    """The content of ``result.json``.

    ``coefficients`` is the first answer of a run, what is true of the vehicle; ``effective`` the
    second, None where the target simulator lacks nothing and both are the same. ``selection`` holds
    the terms that the fit could have added, empty where it was not asked; ``next_log`` what to log
    next time, the most helpful signal first.
    """

    FILE = "result.json"
    INDENT = 2

    schema_version: int = 2
    status: Status
    seed: int
    versions: dict[str, Annotated[str, Field(max_length=200)]]
    settings: dict[str, JsonValue]
    coefficients: dict[str, CoefficientResult]
    flights: tuple[FlightResult, ...]
    findings: tuple[Finding, ...]
    search: SearchResult
    selection: tuple[SelectionRow, ...] = ()
    effective: EffectiveResult | None = None
    next_log: tuple[LogProposal, ...] = ()
    sources: dict[str, Sources] = Field(default_factory=dict)

    @field_validator("findings")
    @classmethod
    def _can_be_worded(cls, findings: tuple[Finding, ...]) -> tuple[Finding, ...]:
        for finding in findings:
            try:
                one_line(finding)
            except (KeyError, IndexError, ValueError, TypeError):
                what = f"finding '{finding.code.value}' lacks what its sentence needs"
                raise refuse(what, "was it edited?") from None
        return findings


@dataclass(frozen=True)
class Gate:
    """A condition of an export: what it is, and what stands against it (nothing if it is met).

    One that could not be looked at has not ``ran``.
    """

    name: str
    objections: tuple[str, ...] = ()
    ran: bool = True

    @property
    def passed(self) -> bool:
        """Whether it was looked at and nothing stands against it."""
        return self.ran and not self.objections


class ExportRecord(Part):
    """An export of a run.

    Attributes
    ----------
    format
        Name of its target.
    file
        Inside the result folder; empty where it was refused.
    gates
        Conditions that were checked.
    refused
        Why it was not written; empty where it was.
    """

    format: str
    file: str = ""
    gates: tuple[Gate, ...] = ()
    refused: str = ""


class ExportRecords(ResultFile):
    """The content of ``exports.json``: what was exported into the result folder, by format."""

    FILE = "exports.json"

    exports: dict[str, ExportRecord] = Field(default_factory=dict)


class Run(BaseModel):
    """A result folder that was read: its result, and the vehicle with the best coefficients.

    ``effective`` is the one for the target simulator, where that is another.
    """

    model_config = ConfigDict(frozen=True)

    folder: Path
    result: RunResult
    vehicle: VehicleFile = Field(description="best_fit.yaml")
    effective: VehicleFile | None = Field(default=None, description="effective.yaml")


def place_for(out: Path | None, *, resume: bool = False) -> Path:
    """Return the folder of `folder_for`, in which there is nothing but what runs wrote.

    Raises
    ------
    InputError
        As of `folder_for` and `check_links`, or a file that no run wrote there would be replaced.
    """
    folder = folder_for(out, resume=resume)
    check_links(folder, IN_FOLDER)
    theirs = [name for name in (*OF_A_RUN, EXPORTS) if exists(folder / name)]
    if theirs and not _is_of_a_run(folder):
        what = f"holds a {theirs[0]} that is of no run and would be replaced"
        raise OutputError(folder, what, "name another folder, or move it away")
    return folder


def _is_of_a_run(folder: Path) -> bool:
    """Return whether a run, of any version, was written into a folder."""
    if any(folder.glob(CHECKPOINTS)):
        return True
    for name in ("result.json", "about.json"):
        with suppress(InputError, ValueError):
            content = from_json(read_bytes(folder / name, most=MAX_BYTES, remedy=REMEDY))
            if isinstance(content, dict) and "schema_version" in content:
                return True
    return False


def forget(folder: Path) -> None:
    """Remove what an earlier run left in a folder: it would be taken for the next one's.

    Raises
    ------
    OutputError
        The system refuses.
    """
    with suppress(InputError):  # of another version
        for record in (ExportRecords.read_if_any(folder) or ExportRecords()).exports.values():
            if record.file.startswith(f"{EXPORTS}/"):
                remove_file(inside(folder / EXPORTS, record.file.removeprefix(f"{EXPORTS}/")))
    for name in OF_A_RUN:
        remove_file(folder / name)


def finished_folder(folder: str | Path) -> Path:
    """Return a folder of results that is there, and out of which no link leads.

    Raises
    ------
    InputError
        It is no folder, or a link leads out of it.
    """
    folder = Path(folder)
    if not (exists(folder) and folder.is_dir()):
        raise InputError(folder, "is no folder", "give the result folder of a run")
    check_links(folder, IN_FOLDER)
    return folder


def read_run(folder: str | Path) -> Run:
    """Read a result folder.

    Raises
    ------
    InputError
        It is no result folder, or is of another schema version, its two files disagree, or a link
        leads out of it.
    """
    folder = finished_folder(folder)
    result = RunResult.read(folder, REMEDY)
    effective = result.effective
    for name in (*result.coefficients, *(effective.coefficients if effective else ())):
        if name not in COEFFICIENTS:
            raise InputError(
                folder / RunResult.FILE, f"unknown coefficient '{name}'", "was it edited?"
            )
    best = {name: row.best for name, row in result.coefficients.items()}
    return Run(
        folder=folder,
        result=result,
        vehicle=_vehicle_with(best, folder / BEST_FIT_FILE),
        effective=_vehicle_with(effective.coefficients, folder / EFFECTIVE_FILE)
        if effective
        else None,
    )


def _vehicle_with(numbers: Mapping[str, float], path: Path) -> VehicleFile:
    """Read a vehicle file of a result folder, whose ``result.json`` has these numbers of it."""
    vehicle = read_vehicle(path)
    for name, value in values_of(vehicle).items():
        if not math.isclose(value, numbers.get(name, value), rel_tol=1e-9):
            what = f"{name} is {value:g}, and {numbers[name]:g} in {RunResult.FILE}"
            raise InputError(path, what, "was one edited? take both files from one run")
    return vehicle
