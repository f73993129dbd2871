"""Options of `tune` as a request to a server: contents in place of paths."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

from tuner.config import Settings, settle
from tuner.core.errors import InputError
from tuner.core.shipped import Kind, configs_folder, find_config
from tuner.core.yaml_document import read_yaml
from tuner.core.yaml_section import Section
from tuner.options import FILES, FitOptions, Options
from tuner.recordings.topics import load_topic_map
from tuner.vehicle import read_vehicle
from tuner.vehicle.controller import read_controller


def request_of(options: FitOptions) -> tuple[tuple[Path, ...], dict[str, Any]]:
    """Return the recordings to send and the request that names them, but for their ids.

    Raises
    ------
    InputError
        A path, name or value cannot be used, here or by any server.
    """
    settled = settle(Options(**vars(options)))
    names = (field.name for field in fields(FitOptions) if field.name not in FILES)
    request = {name: getattr(options, name) for name in names}
    request["settings"] = _settings(settled)
    request["vehicle"] = _content_of("vehicles", read_vehicle, options.vehicle, Path())
    request["controller"] = _content_of("controllers", read_controller, options.controller, Path())
    if options.holdout is not None:
        request["holdout"] = list(settled.job.holdout)
    if options.topics is not None:
        request["settings"]["topics"] = _topics(find_config("topics", options.topics, Path()))
    return settled.flights, {key: value for key, value in request.items() if value is not None}


def _settings(settled: Settings) -> dict[str, Any]:
    """Return the keys of the job file, the files that it names as their contents.

    A lab's job file may speak of recordings beside it that are not sent; a server knows none of
    them.
    """
    if settled.job_path is None:
        return {}
    data = read_yaml(settled.job_path).data
    settings = dict(data) if isinstance(data, dict) else {}
    base = settled.job_path.parent
    sent = {flight.stem for flight in settled.flights}
    settings["holdout"] = list(settled.job.holdout)
    settings["flights"] = {n: v for n, v in (settings.get("flights") or {}).items() if n in sent}
    if settled.job.export.into is not None:
        raise InputError(
            settled.job_path,
            "export.into names a file of this machine",
            "leave it out, and use tune export --into on what you fetch",
        )
    readers: dict[Kind, Callable[[Path], Section]] = {
        "vehicles": read_vehicle,
        "controllers": read_controller,
    }
    for kind, read in readers.items():
        if (named := settings.get(key := kind.removesuffix("s"))) is not None:
            settings[key] = _content_of(kind, read, str(named), base)
    if (named := settings.get("topics")) is not None:
        settings["topics"] = _topics(find_config("topics", str(named), base))
    return settings


def _content_of(
    kind: Kind, read: Callable[[Path], Section], named: str | Section | None, base: Path
) -> str | dict[str, Any] | None:
    """Return what a server is told of a file: the name of one that it has, or its content."""
    if not isinstance(named, str):
        return _content(named)
    path = find_config(kind, named, base)
    return _shipped(kind, path) or _content(read(path))


def _topics(path: Path) -> Any:
    shipped = _shipped("topics", path)
    if shipped is not None:
        return shipped
    topics = load_topic_map(path)
    if topics.messages:
        raise InputError(
            path, "names .msg files, which no server takes", "fit with tune on this machine"
        )
    return _content(topics.replace(extends=None))


def _shipped(kind: Kind, path: Path) -> str | None:
    """Return the name of a file that ships with every server."""
    inside = path.resolve().parent == (configs_folder() / kind).resolve()
    return path.stem if inside else None


def _content(section: Section | None) -> dict[str, Any] | None:
    return None if section is None else section.model_dump(mode="json", exclude_none=True)
