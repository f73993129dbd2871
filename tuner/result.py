"""What a run found, as ``result.json`` and ``best_fit.yaml`` hold it in the result folder."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, JsonValue, ValidationError

from tuner.config import COEFFICIENTS, VehicleFile, read_vehicle
from tuner.config.model import config_error
from tuner.config.yaml_file import Document, write_text
from tuner.errors import ConfigError, InputError

SCHEMA_VERSION = 1
MAX_BYTES = 50_000_000

RESULT_FILE = "result.json"
BEST_FIT_FILE = "best_fit.yaml"


class _Part(BaseModel):
    """A part of the result; keys that a later version adds are passed over."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class CoefficientResult(_Part):
    """One coefficient: where it started, where it ended, how sure that is.

    Attributes
    ----------
    unit
        As in `tuner.config.COEFFICIENTS`.
    initial, best
        Values.
    fitted
        Whether the search moved it.
    lower, upper
        Bounds of the search; None where there were none.
    std_error, ci95
        Standard error and 95 % interval; None where it was not fitted or cannot be told.
    identifiable
        Whether the flights determine it; None where it was not fitted.
    note
        Anything a reader should know.
    """

    unit: str
    initial: float
    best: float
    fitted: bool
    lower: float | None = None
    upper: float | None = None
    std_error: float | None = None
    ci95: tuple[float, float] | None = None
    identifiable: bool | None = None
    note: str = ""


class AxesRmse(_Part):
    """The thesis's six: position along world x, y, z in m; roll, pitch, yaw in degrees.

    None stands for a flight that crashed or an axis that was not recorded.
    """

    x: float | None
    y: float | None
    z: float | None
    roll: float | None
    pitch: float | None
    yaw: float | None


class FlightResult(_Part):
    """One recording: what it was used for and how closely it is met.

    ``duration`` in s; ``time_offset`` in s by which its clock is late; RMSE with the initial and
    the best coefficients.
    """

    name: str
    path: str
    sha256: str
    split: Literal["fit", "holdout"]
    duration: float
    time_offset: float
    rmse_initial: AxesRmse
    rmse_best: AxesRmse


class SearchResult(_Part):
    """How the minimum was found; ``wall_time`` in s."""

    method: str
    evaluations: int
    iterations: int
    wall_time: float
    cost_initial: float | None
    cost_best: float | None
    converged: bool
    message: str


class RunResult(_Part):
    """The content of ``result.json``."""

    schema_version: int
    status: str
    seed: int
    versions: dict[str, str]
    settings: dict[str, JsonValue]
    coefficients: dict[str, CoefficientResult]
    flights: tuple[FlightResult, ...]
    search: SearchResult


class Run(BaseModel):
    """A result folder that was read: what was found, and the vehicle with the best coefficients."""

    model_config = ConfigDict(frozen=True)

    folder: Path
    result: RunResult
    vehicle: VehicleFile = Field(description="best_fit.yaml")


def write_result(result: RunResult, folder: Path) -> None:
    """Write ``result.json``; it appears whole.

    Raises
    ------
    ConfigError
        The folder cannot be written to.
    """
    write_text(folder / RESULT_FILE, result.model_dump_json(indent=2) + "\n")


def read_run(folder: str | Path) -> Run:
    """Read a result folder.

    Raises
    ------
    InputError
        It is no result folder, or was written by a newer version, or its two files disagree.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(folder, "is no folder", "give the result folder of a run")
    path = folder / RESULT_FILE
    result = _read_result(path)
    if result.schema_version > SCHEMA_VERSION:
        raise InputError(
            path,
            f"has schema version {result.schema_version}, newer than {SCHEMA_VERSION}",
            "update tune",
        )
    for name in result.coefficients:
        if name not in COEFFICIENTS:
            raise InputError(path, f"unknown coefficient '{name}'", "was it edited?")
    return Run(folder=folder, result=result, vehicle=read_vehicle(folder / BEST_FIT_FILE))


def _read_result(path: Path) -> RunResult:
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise InputError(
            path, f"cannot be read ({error.strerror})", "give the result folder of a finished run"
        ) from None
    if len(raw) > MAX_BYTES:
        raise InputError(path, "is larger than 50 MB", "give the result folder of a run")
    try:
        return RunResult.model_validate_json(raw)
    except ValidationError as error:
        wrong: ConfigError = config_error(error, Document(path, {}, {}))
        raise InputError(path, wrong.what, wrong.remedy) from None
