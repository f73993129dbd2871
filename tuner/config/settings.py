"""The settings of one job: options over the job file over the defaults."""

from __future__ import annotations

import fnmatch
import glob
import re
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from tuner.config.job import JobFile, Search, read_job
from tuner.core.disk import exists, find_flights
from tuner.core.errors import ConfigError, InputError, did_you_mean
from tuner.core.shipped import Kind, configs_folder, find_config
from tuner.core.validation import config_error
from tuner.core.yaml_section import build, section_of
from tuner.ground.bench_json import joint_prior
from tuner.options import FILES, IN_JOB_FILE, FlightOptions, Options
from tuner.vehicle.controller import ControllerFile, read_controller
from tuner.vehicle.joint_prior import JointPrior
from tuner.vehicle.vehicle import VehicleFile, check_names, check_rotors, read_vehicle, with_values

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
    build(section_of(type(asked), leaving=FILES), given, "command line")
    known: dict[str, Any] = {f.name: getattr(asked, f.name, f.default) for f in fields(Options)}
    options = asked if isinstance(asked, Options) else Options(**known)
    flights = find_flights(options.flights)
    job_path = Path(options.config).expanduser() if options.config else find_job_file(flights)
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
        The flights lie in several folders with a job file each.
    """
    folders = {flight.resolve().parent: flight.parent for flight in flights}
    files = [shown / JOB_FILE for shown in folders.values() if (shown / JOB_FILE).is_file()]
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
