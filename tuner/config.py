"""The job file, ``tune.yaml``, and the settings of a job: options over the file over defaults."""

from __future__ import annotations

import fnmatch
import glob
import os
import re
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

from annotated_types import Interval, Le, Len
from pydantic import AfterValidator, Field, ValidationError, model_validator

from tuner.core.disk import exists, expanded, find_flights
from tuner.core.errors import ConfigError, InputError, did_you_mean
from tuner.core.shipped import EXPORT_TARGETS, KINDS, Kind, configs_folder, find_config
from tuner.core.yaml_section import (
    Flag,
    Number,
    Positive,
    Section,
    Whole,
    build_options,
    config_error,
    read_model,
    refuse,
    section_of,
)
from tuner.ground.measurement import joint_prior
from tuner.options import FILES, IN_JOB_FILE, MAX_SEED, FlightOptions, Method, Options
from tuner.vehicle import COEFFICIENTS, condition_rows, term_groups
from tuner.vehicle.controller import ControllerFile, read_controller
from tuner.vehicle.joint_prior import JointPrior
from tuner.vehicle.vehicle import VehicleFile, check_names, check_rotors, read_vehicle, with_values

#: Recorded signals whose residuals a fit can weigh, in this order everywhere.
CHANNELS = ("position", "attitude", "body_rate", "rotor_speed", "command", "acceleration")

#: Where a recording can be fed into the simulated loop, the upstream places first.
InletName = Literal["reference", "body_rate", "actuator", "rotor_speed", "attitude"]
InletChoice = Literal["auto", InletName]
ErrorKind = Literal["auto", "output", "prediction"]


def _require_known(word: str, known: tuple[str, ...], kind: str) -> str:
    if word not in known:
        raise refuse(f"unknown {kind} '{word}'", did_you_mean(word, known))
    return word


def _terms() -> tuple[str, ...]:
    """Return the names of groups of terms, of the coefficients in them, and of surroundings."""
    groups = term_groups()
    names = (name for group, names in groups.items() for name in names if name != group)
    surroundings = (word for name, row in condition_rows().items() for word in (row.group, name))
    return (*groups, *names, *dict.fromkeys(surroundings))


CoefficientName = Annotated[
    str, AfterValidator(lambda name: _require_known(name, tuple(COEFFICIENTS), "coefficient"))
]
TermName = Annotated[str, AfterValidator(lambda name: _require_known(name, _terms(), "term"))]
FormatName = Annotated[
    str, AfterValidator(lambda name: _require_known(name, tuple(EXPORT_TARGETS), "export format"))
]
ChannelName = Annotated[str, AfterValidator(lambda name: _require_known(name, CHANNELS, "channel"))]


Weight = Annotated[Number, Interval(ge=1e-6, le=1e6)]
TimeOffset = Annotated[Number, Interval(ge=-10, le=10)] | Literal["free"]


class Prior(Section):
    """Prior of a coefficient: mean ± standard deviation, in its unit."""

    mean: Number
    sd: Positive


class CoefficientSettings(Section):
    """Bounds, scale and prior of one coefficient; None leaves the default.

    Attributes
    ----------
    lower, upper
        Bounds, in the coefficient's unit.
    scale
        Whether the search moves the logarithm or the number.
    prior
        Pulls the fit towards a mean.
    """

    lower: Number | None = None
    upper: Number | None = None
    scale: Literal["log", "linear"] | None = None
    prior: Prior | None = None

    @model_validator(mode="after")
    def _bounds_are_in_order(self) -> Self:
        if self.lower is not None and self.upper is not None and self.lower >= self.upper:
            raise refuse(f"lower {self.lower:g} is not below upper {self.upper:g}", "swap them")
        if self.scale == "log":
            for name in ("lower", "upper"):
                value = getattr(self, name)
                if value is not None and value <= 0:
                    raise refuse(
                        f"{name} {value:g} has no logarithm",
                        "give a positive bound or scale: linear",
                    )
            if self.prior is not None and self.prior.mean <= 0:
                raise refuse(
                    f"prior mean {self.prior.mean:g} has no logarithm",
                    "give a positive mean or scale: linear",
                )
        return self


class Search(Section):
    """Settings of the search.

    Attributes
    ----------
    method
        ``gradient`` is Levenberg-Marquardt, ``cma`` is CMA-ES, ``hybrid`` is one after the other.
    criterion
        Whose error is minimised: ``prediction`` is that of open-loop predictions from recorded
        states, ``output`` that of simulations whose starts are free; ``auto`` predicts where the
        recordings hold the state, below rate control, and where little of the turning is explained.
    seed
        Of everything random.
    starts
        How many starting points; the first is the vehicle file's, the others lie around it.
    spread
        Factor within which the others lie on either side of it.
    robust
        ``huber`` bounds the pull of outliers, ``none`` is plain least squares.
    window
        s, length of the windows of inlets below ``reference``; None leaves the inlet's own.
    max_iterations
        Of each stage.
    """

    method: Method = "auto"
    criterion: ErrorKind = "auto"
    seed: Annotated[Whole, Interval(ge=0, le=MAX_SEED)] = 0
    starts: Annotated[Whole, Interval(ge=1, le=1024)] = 1
    spread: Annotated[Number, Interval(gt=1, le=10)] = 2.0
    robust: Literal["huber", "none"] = "huber"
    window: Annotated[Number, Interval(ge=0.1, le=60)] | None = None
    max_iterations: Annotated[Whole, Interval(ge=1, le=100_000)] = 100


def _known_shape(name: str) -> str:
    from sim_jax.trajectory import shapes  # noqa: PLC0415 (loads JAX, which most commands spare)

    if name not in shapes():
        raise refuse(f"there is no trajectory '{name}'", f"name one of {', '.join(shapes())}")
    return name


TrajectoryName = Annotated[str, AfterValidator(_known_shape)]


MAX_SPEED_SCALE = 1e4


class TrajectorySettings(Section):
    """The trajectory of a recording that holds no reference; keys and units of ``tune simulate``.

    Attributes
    ----------
    name
        Which shape.
    radius
        m.
    omega
        rad/s.
    speed_scale
        The publisher's velocity scaler.
    yaw_rate
        rad/s, of a yaw spin.
    """

    name: TrajectoryName
    radius: Annotated[Number, Interval(gt=0, le=1e4)] = 2.0
    omega: Annotated[Number, Interval(gt=0, le=1e3)] = 0.7
    speed_scale: Annotated[Number, Interval(gt=0, le=MAX_SPEED_SCALE)] = 2.1
    yaw_rate: Annotated[Number, Interval(ge=-1e3, le=1e3)] = 2.0


class FlightSettings(Section):
    """Settings of one flight; None leaves those of all.

    Attributes
    ----------
    inlet
        Where the recording is fed into the simulated loop.
    weight
        Multiplies the flight's residuals.
    time_offset
        s by which the recording's clock is late, or ``free`` to have it fitted.
    trajectory
        What was flown, where the recording holds no reference.
    """

    inlet: InletChoice | None = None
    weight: Weight = 1.0
    time_offset: TimeOffset | None = None
    trajectory: TrajectorySettings | None = None


class ExportSettings(Section):
    """Exports into the result folder beside ``best_fit.yaml``.

    Attributes
    ----------
    formats
        ``yaml``, the vehicle file with source and confidence of each coefficient, and ``sdf``, the
        model or, without one, its tags, by default; any other of ``tune export``. One for a
        simulator that lacks some of what acts takes a minute for the coefficients that it needs.
    into
        The SDF model that ``sdf`` starts from; the original stays as it is.
    """

    formats: tuple[FormatName, ...] = ("yaml", "sdf")
    into: Path | None = None


class JobFile(Section):
    """The settings of one tuning job.

    Attributes
    ----------
    vehicle, controller, topics
        Files, or None for what ships. `read_job` makes paths absolute and finds shipped names.
    namespace
        Prefix of the recorded topics that the topic map does not have, as ``uav1``.
    mass
        kg, as weighed; instead of the vehicle file's.
    simulated
        Whether a simulator flew the recordings; the report says so.
    holdout
        Flights that are evaluated, never fitted.
    free
        Exactly the coefficients to fit; None for the tuner's own choice.
    fixed
        Coefficients to leave alone, out of the tuner's own choice.
    terms
        What the fit may hold beyond Gazebo's motor model: ``auto`` adds those without which flights
        left out are predicted worse, ``none`` adds none; else the groups, or coefficients, to add.
    disturbances
        ``follow`` fits once more where the residuals hold more than measurement noise and rate and
        thrust set-points were recorded: an extended Kalman filter estimates the disturbances, which
        takes some minutes; of more than some four minutes of flight it is left to the intervals, as
        ``none`` leaves it. ``auto`` follows where the fit has chosen its terms, so that what is
        left is none of them.
    target
        Which of a run's two answers the exports for simulators hold: ``gazebo``, the coefficients
        with which the simulator of each format, which lacks some of the terms, flies most like the
        vehicle; ``physical``, the vehicle's own. Those for Gazebo are in the result.
    coefficients
        Bounds, scale and prior of single coefficients.
    ties
        Groups that share one value, each kept at the ratio of the starting values.
    channels
        Recorded signals to use or not; those not named are used where they were recorded.
    weights
        Multiplies a channel's residuals, on top of the weight that its noise gives it.
    inlet
        Where recordings are fed into the simulated loop.
    time_offset
        s by which the recordings' clocks are late, or ``free`` to have each fitted.
    search, flights, export
        See there; ``flights`` goes by file name without suffix.
    """

    vehicle: Path | None = None
    controller: Path | None = None
    topics: Path | None = None
    namespace: str = ""
    mass: Annotated[Positive, Le(500)] | None = None
    simulated: Flag = False
    holdout: tuple[str, ...] = ()
    free: Annotated[tuple[CoefficientName, ...], Len(min_length=1)] | None = None
    fixed: tuple[CoefficientName, ...] = ()
    terms: Literal["auto", "none"] | tuple[TermName, ...] = "auto"
    disturbances: Literal["auto", "none", "follow"] = "auto"
    target: Literal["gazebo", "physical"] = "gazebo"
    coefficients: dict[CoefficientName, CoefficientSettings] = Field(default_factory=dict)
    ties: tuple[Annotated[tuple[CoefficientName, ...], Len(min_length=2)], ...] = ()
    channels: dict[ChannelName, Flag] = Field(default_factory=dict)
    weights: dict[ChannelName, Weight] = Field(default_factory=dict)
    inlet: InletChoice = "auto"
    time_offset: TimeOffset = "free"
    search: Search = Search()
    flights: dict[str, FlightSettings] = Field(default_factory=dict)
    export: ExportSettings = ExportSettings()

    @model_validator(mode="after")
    def _contradict_nothing(self) -> Self:
        if self.free is not None and self.fixed:
            raise refuse("both 'free' and 'fixed' are given", "keep one of them")
        _require_once("free", self.free or ())
        _require_once("terms", () if isinstance(self.terms, str) else self.terms)
        for term in () if isinstance(self.terms, str) else self.terms:
            for name in term_groups().get(term, (term,)):
                if name in self.fixed:
                    raise refuse(
                        f"'{name}' is both among terms and fixed", "keep it in one of them"
                    )
        _require_once("ties", tuple(name for group in self.ties for name in group))
        if self.channels and not any(self.channels.get(name, True) for name in CHANNELS):
            raise refuse("every channel is switched off", "leave one on")
        return self


def read_job(path: str | Path) -> JobFile:
    """Read a job file; paths in it count from its folder.

    Raises
    ------
    ConfigError
        In one line: the file, the key, its value, what it should be.
    """
    path = Path(path)
    job = read_model(JobFile, path)
    paths: dict[str, Path] = {}
    for key, kind in KINDS.items():
        reference = getattr(job, key)
        if reference is not None:
            try:
                paths[key] = find_config(kind, str(reference), path.parent)
            except ConfigError as error:
                raise ConfigError(path, f"{key} '{reference}' {error.what}", error.remedy) from None
    if job.export.into is not None:
        into = path.parent / expanded(job.export.into)
        return job.model_copy(update=paths | {"export": job.export.replace(into=into)})
    return job.model_copy(update=paths)


def _require_once(key: str, names: tuple[str, ...]) -> None:
    for name in names:
        if names.count(name) > 1:
            raise refuse(f"{key} names '{name}' twice", "keep it once")


JOB_FILE = "tune.yaml"
DEFAULT_NAME = "hovergames"


@dataclass(frozen=True)
class Settings:
    """A settled job.

    Attributes
    ----------
    flights
        The recordings, those held out too; their stems are distinct.
    vehicle
        Where the fit starts, the weighed mass in it.
    job
        The job file with the command line's choices in it; ``holdout`` names given flights only.
    job_path
        The job file that was read, None without one.
    origin
        Setting to where it comes from, in words: the command line, a file, or the default.
    bench
        What ground measurements say; None without.
    """

    flights: tuple[Path, ...]
    vehicle: VehicleFile
    controller: ControllerFile
    job: JobFile
    job_path: Path | None
    origin: Mapping[str, str]
    bench: JointPrior | None = None

    @property
    def weighed(self) -> bool:
        """Whether the user gave the mass: by an option, or a file of their own."""
        origin = self.origin["mass"]
        return not (origin.startswith("default") or str(configs_folder()) in origin)


def resolve_settings(asked: FlightOptions, *, fits: bool = True) -> Settings:
    """Read what the options and the flights' job file name, and let the command line win.

    Parameters
    ----------
    asked
        Of the command line, or as Python and HTTP give them; those that a fit has.
    fits
        Whether a fit follows, for which some flight must not be held out.

    Raises
    ------
    InputError
        A path, name or value cannot be used.
    """
    given = {name: value for name, value in vars(asked).items() if name not in FILES}
    build_options(section_of(type(asked), leaving=FILES), given)
    known: dict[str, Any] = {f.name: getattr(asked, f.name, f.default) for f in fields(Options)}
    options = asked if isinstance(asked, Options) else Options(**known)
    flights = find_flights(options.flights)
    job_path = expanded(options.config) if options.config else find_job_file(flights)
    job = read_job(job_path) if job_path else JobFile()
    origin: dict[str, str] = {}

    holdout, extra = _holdout(options, job, flights)
    flights = (*flights, *extra)
    _require_distinct_names(flights)
    _check_flight_names(job, job_path, flights)
    if fits and all(flight.stem in holdout for flight in flights):
        raise InputError("--holdout", "holds out all flights", "leave one to fit")
    try:
        job = _override(job, options, holdout)
    except ValidationError as error:
        raise config_error(error, Path("command line")) from None

    named = options.vehicle
    if named is None and options.bench is not None:
        named = str(Path(options.bench) / "best_fit.yaml")
    vehicle, origin["vehicle"] = _choose_file(
        "vehicles", read_vehicle, named, job.vehicle, job_path
    )
    check_rotors(vehicle)
    controller, origin["controller"] = _choose_file(
        "controllers", read_controller, options.controller, job.controller, job_path
    )
    if job.mass is not None:
        vehicle = with_values(vehicle, {"mass": job.mass})
    origin["mass"] = _origin_of(
        "--mass" if options.mass is not None else None,
        job_path if job.mass is not None else None,
        origin["vehicle"],
    )
    origin["holdout"] = _origin_of(
        "--holdout" if options.holdout is not None else None, job_path if holdout else None
    )
    origin["free coefficients"] = _origin_of(
        "--fit" if options.fit is not None else "--fix" if options.fix is not None else None,
        job_path if job.free is not None or job.fixed else None,
    )
    bench = None
    if options.bench is not None:
        bench, origin["bench"] = joint_prior(Path(options.bench)), f"--bench {options.bench}"
    return Settings(flights, vehicle, controller, job, job_path, origin, bench)


def find_job_file(flights: Iterable[Path]) -> Path | None:
    """Return the ``tune.yaml`` beside the flights, None without one.

    Raises
    ------
    ConfigError
        The flights lie in several folders with a job file each, or one is called ``tune.yml``.
    """
    folders = {flight.parent.resolve(): flight.parent for flight in flights}
    files = [shown / JOB_FILE for shown in folders.values() if os.path.lexists(shown / JOB_FILE)]
    for shown in folders.values():
        misnamed = shown / "tune.yml"
        if os.path.lexists(misnamed) and shown / JOB_FILE not in files:
            raise ConfigError(misnamed, "is not read", f"call it {JOB_FILE}")
    if len(files) > 1:
        raise ConfigError(
            files[1], f"is a second job file beside {files[0]}", "name one of them with --config"
        )
    return files[0] if files else None


M = TypeVar("M", VehicleFile, ControllerFile)


def _choose_file(
    kind: Kind,
    read: Callable[[Path], M],
    option: str | M | None,
    in_job: Path | None,
    job_path: Path | None,
) -> tuple[M, str]:
    """Return the first named file, and its origin."""
    if isinstance(option, str):
        path = find_config(kind, option, Path())
        return read(path), f"--{kind.removesuffix('s')} {path}"
    if option is not None:
        return option, f"--{kind.removesuffix('s')} '{option.name}'"
    if in_job is not None:
        return read(in_job), f"{in_job} ({job_path})"
    path = find_config(kind, DEFAULT_NAME, Path("/nonexistent"))
    return read(path), f"default ({path.name})"


def _origin_of(option: str | None, job_path: Path | None, otherwise: str = "default") -> str:
    return option or (str(job_path) if job_path else otherwise)


def _holdout(
    options: Options, job: JobFile, flights: tuple[Path, ...]
) -> tuple[tuple[str, ...], tuple[Path, ...]]:
    """Return the held-out flights' names and the recordings that are named only as such."""
    names = {flight.stem for flight in flights}
    if options.holdout is None:
        return tuple(name for name in job.holdout if names_recording(name, names)), ()
    holdout: list[str] = []
    extra: list[Path] = []
    for word in options.holdout:
        if names_recording(word, names):
            holdout.append(word)
        elif meant := sorted(fnmatch.filter(names, word)):  # before files that happen to lie here
            holdout += meant
        elif exists(Path(word)) or glob.has_magic(word):
            for path in find_flights([word]):
                holdout.append(path.stem)
                if path.resolve() not in {flight.resolve() for flight in (*flights, *extra)}:
                    extra.append(path)
        else:
            raise InputError("--holdout", f"there is no flight '{word}'", did_you_mean(word, names))
    return tuple(dict.fromkeys(holdout)), tuple(extra)


def _override(job: JobFile, options: Options, holdout: tuple[str, ...]) -> JobFile:
    """Return the job file's settings with the command line's over them."""
    check_names(options.fit or (), "--fit")
    check_names(options.fix or (), "--fix")
    if options.fit is not None and options.fix is not None:
        raise ConfigError("--fit", "cannot stand beside --fix", "give one of them")
    if options.fit is not None and not options.fit:
        raise ConfigError("--fit", "names no coefficient", "name some, or leave it out")
    given = {
        IN_JOB_FILE.get(option, option): value
        for option, value in vars(options).items()
        if value is not None and option not in FILES
    }
    changes: dict[str, object] = {key: given[key] for key in JobFile.model_fields if key in given}
    changes |= {"holdout": holdout}
    if options.fit is not None:
        changes |= {"free": tuple(dict.fromkeys(options.fit)), "fixed": ()}
    elif options.fix is not None and job.free is not None:
        changes |= {"free": tuple(name for name in job.free if name not in options.fix)}
        del changes["fixed"]
    elif options.fix is not None:
        changes["fixed"] = tuple(dict.fromkeys((*job.fixed, *options.fix)))
    if options.topics is not None:
        changes["topics"] = find_config("topics", options.topics, Path())
    changes["search"] = job.search.replace(
        **{key: given[key] for key in Search.model_fields if key in given}
    )
    return job.replace(**changes)


def names_recording(name: str, recordings: Collection[str]) -> bool:
    """Return whether a flight is of one of these recordings: the only mission, or ``NAME-2``."""
    return name in recordings or re.sub(r"-\d+$", "", name) in recordings


def _require_distinct_names(flights: tuple[Path, ...]) -> None:
    seen: dict[str, Path] = {}
    for flight in flights:
        if flight.stem in seen:
            raise InputError(
                flight, f"has the same name as {seen[flight.stem]}", "rename one of the recordings"
            )
        seen[flight.stem] = flight


def _check_flight_names(job: JobFile, job_path: Path | None, flights: tuple[Path, ...]) -> None:
    """Refuse settings for a flight that exists neither here nor beside the job file."""
    given = [flight.stem for flight in flights]
    folders = {flight.parent for flight in flights} | ({job_path.parent} if job_path else set())
    known = {file.stem for folder in folders for file in folder.glob("*")} | set(given)
    for name in (*job.holdout, *job.flights):
        if not names_recording(name, known):
            raise ConfigError(
                job_path or "flights",
                f"names a flight '{name}' that does not exist",
                did_you_mean(name, given),
            )
