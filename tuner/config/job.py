"""The job file, ``tune.yaml``: all settings of a fit, none of them required."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

from annotated_types import Ge, Interval, Le, Len
from pydantic import AfterValidator, Field, model_validator

from tuner.core.errors import ConfigError, did_you_mean
from tuner.core.shipped import EXPORT_TARGETS, KINDS, find_config
from tuner.core.yaml_section import Flag, Number, Positive, Section, Whole, read_model, refuse
from tuner.options import Method
from tuner.vehicle import COEFFICIENTS, condition_rows, term_groups

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
    seed: Annotated[Whole, Ge(0)] = 0
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
    radius: Positive = 2.0
    omega: Positive = 0.7
    speed_scale: Positive = 2.1
    yaw_rate: Number = 2.0


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
    time_offset: Number | Literal["free"] | None = None
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
    time_offset: Number | Literal["free"] = "free"
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
        into = path.parent / job.export.into.expanduser()
        return job.model_copy(update=paths | {"export": job.export.replace(into=into)})
    return job.model_copy(update=paths)


def _require_once(key: str, names: tuple[str, ...]) -> None:
    for name in names:
        if names.count(name) > 1:
            raise refuse(f"{key} names '{name}' twice", "keep it once")
