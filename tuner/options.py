"""The options of `tune`: the one list of which its command line, Python and HTTP are made.

An option is a field of one of these classes: its type with its bounds, its default and, below it,
its help. Where a job file has a key of the same name, the option wins over that key. Nothing here
is slow to import, for `tune --help` shows it at once.
"""

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import KW_ONLY, dataclass, fields
from functools import wraps
from pathlib import Path
from types import SimpleNamespace
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Literal,
    Self,
    TypeVar,
    cast,
    get_type_hints,
)

from annotated_types import Gt, Interval, Le

from tuner.core.errors import ConfigError, did_you_mean

if TYPE_CHECKING:
    from tuner.vehicle import ControllerFile, VehicleFile

    Vehicle = str | VehicleFile
    Controller = str | ControllerFile
else:  # a command line names them; from Python they may be what such a file holds
    Vehicle = Controller = str

F = TypeVar("F", bound=Callable[..., object])
Names = Sequence[str]
Method = Literal["auto", "gradient", "cma", "hybrid"]

FILES = ("flights", "vehicle", "controller", "config", "topics")
"""Options that name files, or what they hold."""
MODELS = ("vehicle", "controller")
"""Options that name a file or, from Python, may be what such a file holds."""
PATHS = ("into", "out")
"""Options that name what is written."""
MAX_SEED = 2**31 - 1
"""The libraries that draw random numbers take 32 bits, and searches add a little to a seed."""
IN_JOB_FILE: Mapping[str, str] = {"fit": "free", "fix": "fixed", "global_": "global_method"}
"""Option -> what the job file, and Python, call it where that differs."""


class FromPython:
    """Options that a function of Python takes by their names."""

    @classmethod
    def of(cls, **given: Any) -> Self:
        """Return options as Python gives them: ``free`` and ``fixed``, and paths for text.

        Raises
        ------
        ConfigError
            There is no such option, or its value is of another type or out of range.
        """
        from tuner.core.yaml_section import check_types  # noqa: PLC0415 (pydantic)

        types = get_type_hints(cls, include_extras=True)
        option_of = {IN_JOB_FILE.get(f.name, f.name): f.name for f in fields(cls)}  # type: ignore[arg-type]
        for name in given:
            if name not in option_of:
                known = [IN_JOB_FILE[name]] if name in IN_JOB_FILE else option_of
                raise ConfigError(name, "is no option", did_you_mean(name, known))
        words = {name: plain(value) for name, value in given.items()}
        if isinstance(words.get("flights"), str):
            words["flights"] = [words["flights"]]
        models = [name for name in MODELS if words.get(name) is not None]
        for name in models:
            check_model(name, words[name])
        checked = {name: value for name, value in words.items() if name not in models}
        check_types(checked, {name: types[option_of[name]] for name in checked}, "options")
        words = {option_of[name]: value for name, value in words.items()}
        folders = {name: Path(words[name]) for name in PATHS if words.get(name) is not None}
        return cls(**words | folders)


@dataclass(frozen=True)
class FlightOptions(FromPython):
    """Recordings, and what flew."""

    flights: Names
    """Use these recordings: paths as the shell expands them, or a quoted glob."""
    _: KW_ONLY
    controller: Controller | None = None
    """Simulate this controller (file or shipped). Default: the job file's, else hovergames."""
    config: str | None = None
    """Read settings from this job file. Default: tune.yaml beside the flights, if there is one."""


@dataclass(frozen=True, kw_only=True)
class ReadingOptions:
    """How recordings are read."""

    topics: str | None = None
    """Find signals by this topic map (file or shipped). Default: the one that finds the most."""
    namespace: str | None = None
    """Expect this prefix before the topics that the topic map names."""


@dataclass(frozen=True, kw_only=True)
class RecordingOptions(ReadingOptions, FlightOptions):
    """Recordings, what flew, and how they are read."""


@dataclass(frozen=True, kw_only=True)
class VehicleOptions(RecordingOptions):
    """Recordings, and the vehicle whose coefficients they show."""

    vehicle: Vehicle | None = None
    """Start from this vehicle (file or shipped). Default: the job file's, else hovergames."""
    mass: Annotated[float, Gt(0), Le(500)] | None = None
    """Use this weighed take-off mass in kg instead of the vehicle file's."""
    fit: Names | None = None
    """Fit, or judge, exactly these coefficients."""
    fix: Names | None = None
    """Fit, or judge, the usual coefficients except these."""


@dataclass(frozen=True, kw_only=True)
class FitOptions(VehicleOptions):
    """What is fitted to which flights, on this machine or on a server."""

    holdout: Names | None = None
    """Evaluate these flights without fitting them."""
    method: Method | None = None
    """Search with this method. Default: the job file's, else auto."""
    seed: Annotated[int, Interval(ge=0, le=MAX_SEED)] | None = None
    """Start the random numbers from this seed. Default: the job file's, else 0."""
    force: bool = False
    """Search even where the check before the search reports a failure."""
    cross_validate: bool = False
    """Also fit without each flight in turn: how it is predicted, and jackknife standard errors."""
    bootstrap: Annotated[int, Interval(ge=2, le=1000)] | None = None
    """Also fit this many times to flights drawn with replacement, for standard errors; say 50."""


@dataclass(frozen=True, kw_only=True)
class EngineOptions:
    """Where independent work is computed; the numbers are the same."""

    workers: int | None = None
    """Compute what is independent in this many local processes, a core each."""
    cluster: str | None = None
    """Compute what is independent on a Dask cluster: a cluster file, or tcp://HOST:8786."""


@dataclass(frozen=True, kw_only=True)
class RunOptions(EngineOptions):
    """Where results are computed, and where they are written."""

    out: Path | None = None
    """Write into this folder. Default: runs/ and the time."""


@dataclass(frozen=True, kw_only=True)
class ExaminationOptions(RunOptions, VehicleOptions):
    """Coefficients that are examined on recordings, nothing fitted."""

    global_: Literal["morris", "sobol"] | None = None
    """Also compute the indices of Morris or Sobol over the range of the coefficients."""
    samples: Annotated[int, Interval(ge=2, le=100_000)] | None = None
    """Compute them from this many trajectories (Morris, default 16) or base points (Sobol, 64)."""
    span: Annotated[float, Interval(gt=0, le=1000)] = 30.0
    """Vary coefficients without bounds in the job file by this many percent for them."""
    profile: Names | None = None
    """Profile the likelihood of these coefficients: fit the others again along a grid of values."""


@dataclass(frozen=True, kw_only=True)
class Options(RunOptions, FitOptions):
    """All options of a fit on this machine."""

    bench: str | None = None
    """Start from these ground measurements, a folder of tune bench, and take them as prior."""
    resume: bool = False
    """Continue the search that was interrupted in the result folder from its checkpoint."""


@dataclass(frozen=True, kw_only=True)
class TrajectoryOptions(FromPython):
    """A trajectory, and what flies it."""

    trajectory: str
    """Fly this shape, such as circle, from rest; a name that does not exist lists all of them."""
    vehicle: Vehicle = "hovergames"
    """Fly this vehicle file, or a shipped one by its name, say hovergames_updated."""
    controller: Controller = "hovergames"
    """Fly this controller file, or a shipped one by its name: hovergames_sitl."""
    radius: float = 2.0
    """Set the radius in m."""
    omega: float = 0.7
    """Set the angular rate of the trajectory in rad/s."""
    speed_scale: float = 2.1
    """Set the publisher's velocity scaler."""
    speed: float | None = None
    """Choose the velocity scaler so that the reference peaks at this speed in m/s."""
    yaw_rate: float = 2.0
    """Set the rate of the yaw spin in rad/s."""
    duration: float = 40.0
    """Fly for this many s."""
    rate: float = 100.0
    """Write samples at this rate in Hz."""
    precision: Literal["float32", "float64"] = "float64"
    """Compute in this precision. float32 is twice as fast for many vehicles, and 0.02 mm off."""


@dataclass(frozen=True, kw_only=True)
class SimulationOptions(EngineOptions, TrajectoryOptions):
    """A trajectory, what flies it, and where that is computed."""


@dataclass(frozen=True)
class ExportOptions(FromPython):
    """The format that coefficients are written in, and where.

    Attributes
    ----------
    format
        Write a vehicle file with confidence intervals (yaml), numbers with units (json), a model of
        Gazebo classic (sdf) or gz-sim (gz-sim; or sdf, where the model is one), parameters of PX4
        (px4), MuJoCo's MJCF (mujoco), parameters of crazyflow (drone-models) or RotorPy (rotorpy),
        or arguments of Isaac Lab's multirotor (isaaclab).
    into
        Put the coefficients into this model (.sdf or .sdf.jinja), and into what it includes from
        folders beside its own. Default: write the tags alone.
    out
        Write this file; a folder, where the model is split over several. Default: the model itself,
        or export/ in the result folder.
    simulator
        Write for this simulator of a format's: gazebo-classic or gz-sim (sdf), sih or gz-sim
        (px4). Default: the one that the model is for, or the first.
    accept
        Export although a condition is not met, and record this reason in the file.
    draws
        Also write so many draws of the joint posterior into the folder --out: a table, a file for
        each in the format, and Isaac Lab's ranges. Default folder: export/draws of the result.
    """

    format: str
    _: KW_ONLY
    into: Path | None = None
    out: Path | None = None
    simulator: str = ""
    accept: str = ""
    draws: int | None = None


def taking(options: type | None = None) -> Callable[[F], F]:
    """Check the types of a function's own parameters, and show the fields of ``**options``."""

    def shown(function: F) -> F:
        signature = inspect.signature(function)
        own = [p for p in signature.parameters.values() if p.kind is not p.VAR_KEYWORD]

        @wraps(function)
        def checked(*given: Any, **named: Any) -> Any:
            import numpy as np  # noqa: PLC0415 (what asks for help alone does not need it)

            from tuner.core.yaml_section import check_types  # noqa: PLC0415 (pydantic)

            bound = signature.bind(*given, **named)
            # without that of the result, whose import takes its time
            types = {p.name: p.annotation for p in own if p.annotation is not p.empty}
            hinted = SimpleNamespace(__annotations__=types)
            hints = get_type_hints(hinted, inspect.unwrap(function).__globals__)
            own_given = {n: plain(bound.arguments[n]) for n in hints if n in bound.arguments}
            check_types(own_given, hints, "options")
            bound.arguments |= own_given
            usual: dict[str, Any] = dict.fromkeys(("divide", "over", "invalid"), "warn")
            with np.errstate(under="ignore", **usual):  # whatever its caller has set
                return function(*bound.args, **bound.kwargs)

        more = [
            inspect.Parameter(
                IN_JOB_FILE.get(field.name, field.name),
                inspect.Parameter.KEYWORD_ONLY,
                default=field.default,
                annotation=field.type,
            )
            for field in (() if options is None else fields(options))
            if field.name not in signature.parameters
        ]
        checked.__signature__ = signature.replace(parameters=[*own, *more])  # type: ignore[attr-defined]
        return cast(F, checked)

    return shown


def plain(value: Any) -> Any:
    """Return paths as text, one or several of them, and NumPy's numbers and lists as Python's.

    What can be gone through once is a list, and a set one in its order: what it holds is the same
    however often it is looked at.
    """
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Set):
        return sorted((plain(item) for item in value), key=str)
    if isinstance(value, list | tuple | Iterator):
        return [plain(item) for item in value]
    return value.tolist() if hasattr(value, "tolist") else value


def check_model(kind: str, value: object) -> None:
    """Refuse what is neither the name of a vehicle or controller nor one itself.

    Raises
    ------
    ConfigError
        It is something else.
    """
    from tuner.vehicle import ControllerFile, VehicleFile  # noqa: PLC0415 (pydantic)

    model = VehicleFile if kind == "vehicle" else ControllerFile
    if not isinstance(value, str | model):
        remedy = f"give a file, the name of a shipped {kind} or a {model.__name__}"
        raise ConfigError(kind, f"is of type {type(value).__name__}", remedy)
