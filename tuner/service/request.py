"""The request for a job, checked as far as that goes without reading a recording."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, TypeVar

from annotated_types import Len
from pydantic import AfterValidator, ConfigDict, Field, JsonValue

from tuner.config import JOB_FILE, JobFile, names_recording, resolve_settings
from tuner.core.disk import file_name, inside
from tuner.core.errors import ConfigError, InputError, did_you_mean
from tuner.core.shipped import KINDS, shipped
from tuner.core.yaml_section import Section, build, dump_yaml, refuse, section_of
from tuner.options import FILES, FitOptions, Options
from tuner.recordings.topics import TopicMap
from tuner.service.errors import is_plain_name
from tuner.vehicle import ControllerFile, VehicleFile

FLIGHTS = "flights"
"""Folder of a job's recordings, and of its job file."""


def _one_line(text: str) -> str:
    if not text.isprintable():
        raise refuse("a name holds characters that cannot be printed", "leave them out")
    return text


M = TypeVar("M", bound=Section)
Word = Annotated[str, Len(max_length=200), AfterValidator(_one_line)]
Named = Word | dict[str, JsonValue]
Digest = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
OptionsOfJob = section_of(FitOptions, leaving=FILES, text=Word)
"""The options of `tune` that name no file."""


class JobRequest(OptionsOfJob, Section):  # type: ignore[misc, valid-type]
    """A job: recordings, what is to be fitted to them, and options that win over the settings.

    The options are those of `tune`.

    Attributes
    ----------
    recordings
        Ids of uploaded recordings.
    names
        What this job calls some of them, by id: file names. Else as they were first uploaded.
    vehicle, controller
        A shipped file's name, or what such a file holds, as JSON. A vehicle may also be named that
        an earlier job was of.
    settings
        The keys of ``tune.yaml``.
    name
        What lists call the job.
    """

    model_config = ConfigDict(
        json_schema_extra={
            "example": {"recordings": ["0" * 64], "holdout": ["circle_4mps"], "settings": {}}
        }
    )

    recordings: Annotated[tuple[Digest, ...], Len(min_length=1, max_length=1000)]
    names: dict[Digest, Annotated[str, Len(max_length=1000)]] = Field(default_factory=dict)
    vehicle: Named | None = None
    controller: Named | None = None
    settings: dict[str, JsonValue] = Field(default_factory=dict)
    name: Word = ""


class CheckedRequest(OptionsOfJob, Section):  # type: ignore[misc, valid-type]
    """A request that was checked, as the job table keeps it: nothing in it is a path.

    Attributes
    ----------
    vehicle, controller, topics
        A shipped file's name, or what such a file holds.
    settings
        The keys of ``tune.yaml`` but those.
    """

    vehicle: str | VehicleFile | None = None
    controller: str | ControllerFile | None = None
    topics: str | TopicMap | None = None
    settings: dict[str, JsonValue] = Field(default_factory=dict)

    def lay_out(self, folder: Path) -> None:
        """Write the files that `options` names, beside the recordings in ``folder/flights``.

        Raises
        ------
        OutputError
            They cannot be written.
        """
        if self.settings:
            (folder / FLIGHTS / JOB_FILE).write_text(dump_yaml(self.settings), encoding="utf-8")
        if isinstance(self.topics, TopicMap):
            content = self.topics.model_dump(mode="json", exclude_none=True)
            (folder / "topics.yaml").write_text(dump_yaml(content), encoding="utf-8")

    def options(self, folder: Path, flights: Sequence[str]) -> Options:
        """Return the options of `tune` for files in ``folder/flights``."""
        topics = str(folder / "topics.yaml") if isinstance(self.topics, TopicMap) else self.topics
        return Options(
            [str(folder / FLIGHTS / name) for name in flights],
            vehicle=self.vehicle,
            controller=self.controller,
            config=str(folder / FLIGHTS / JOB_FILE) if self.settings else None,
            topics=topics,
            **{option: getattr(self, option) for option in OptionsOfJob.model_fields},
        )


def check_request(
    request: JobRequest, flights: Sequence[str], earlier: Mapping[str, Mapping[str, Any]]
) -> tuple[CheckedRequest, str, frozenset[str]]:
    """Check a request, and return it with its vehicle's name and the held-out flights.

    Parameters
    ----------
    flights
        The files' names of its recordings, fit to be names here.
    earlier
        Vehicles of earlier jobs: name -> content.

    Raises
    ------
    InputError
        A key, a name or a value cannot be used; one line says what to do.
    """
    settings = dict(request.settings)
    named = {key: settings.pop(key, None) for key in KINDS}
    for key in ("vehicle", "controller"):
        given = getattr(request, key)
        named[key] = named[key] if given is None else given
    job = build(JobFile, settings, "settings")
    if job.export.into is not None:
        what = "export.into names a file, and the service has only what it is sent"
        raise ConfigError("settings", what, "fetch the result and use tune export --into")
    of = named["vehicle"]
    if isinstance(of, str) and of in earlier and of not in shipped("vehicles"):
        named["vehicle"] = dict(earlier[of])
    options = {option: getattr(request, option) for option in OptionsOfJob.model_fields}
    asked = CheckedRequest(
        **options | {"holdout": _holdout(options["holdout"], flights)},
        vehicle=_parameter_file("vehicle", named["vehicle"], VehicleFile, earlier),
        controller=_parameter_file("controller", named["controller"], ControllerFile),
        topics=_topics(named["topics"]),
        settings=settings,
    )
    with tempfile.TemporaryDirectory(prefix="tune-check-") as name:
        folder = Path(name)
        (folder / FLIGHTS).mkdir()
        for flight in flights:
            place = inside(folder / FLIGHTS, flight)
            if place.exists():
                raise InputError(
                    flight, "is the name of two recordings", "rename one and upload it again"
                )
            place.touch()
        asked.lay_out(folder)
        try:
            settled = resolve_settings(asked.options(folder, flights))
        except InputError as error:
            raise type(error)(
                *(_remove_keys(folder, text) for text in (error.where, error.what, error.remedy))
            ) from None
    name = settled.vehicle.name
    if not is_plain_name(name):
        raise ConfigError("vehicle", "name is no plain name", "give one of up to 100 letters")
    return asked, name, frozenset(settled.job.holdout)


def _holdout(names: Sequence[str] | None, flights: Sequence[str]) -> tuple[str, ...] | None:
    """Return the names of flights that are meant: by their names or their files' names."""
    if names is None:
        return None
    known = stems(flights)
    chosen = []
    for name in names:
        meant = (name, *stems([last_part(name), recording_name(name)]))
        stem = next((s for s in meant if names_recording(s, known)), None)
        if stem is None:
            raise InputError("holdout", f"there is no flight '{name}'", did_you_mean(name, known))
        chosen.append(stem)
    return tuple(chosen)


def _parameter_file(
    key: str, given: Any, model: type[M], earlier: Mapping[str, object] | None = None
) -> str | M | None:
    """Return a shipped file's name, or the given content of such a file."""
    if given is None:
        return None
    if isinstance(given, Mapping):
        return build(model, given, key)
    shipped_names = [*shipped(KINDS[key])]
    if not isinstance(given, str) or given not in shipped_names:
        known = [*shipped_names, *(earlier or ())]
        remedy = f"{did_you_mean(str(given), known)} or give the content of its file"
        raise ConfigError(key, f"'{given}' is not known here", remedy)
    return given


def _topics(given: Any) -> str | TopicMap | None:
    topics = _parameter_file("topics", given, TopicMap)
    if isinstance(topics, TopicMap):
        if topics.messages:
            what = "messages names files, and the service has only what it is sent"
            raise ConfigError("topics", what, "record in a format that defines its messages")
        if topics.extends is not None and topics.extends not in shipped("topics"):
            remedy = did_you_mean(topics.extends, shipped("topics"))
            raise ConfigError("topics", f"extends '{topics.extends}', which is unknown", remedy)
    return topics


def _remove_keys(folder: Path, text: str) -> str:
    """Return a message without the folder that the check was made in."""
    for place in (folder.resolve() / FLIGHTS, folder / FLIGHTS, folder):
        text = text.replace(f"{place}/", "")
    return text


_SIDE_CARS = (".yaml", ".yml")


def last_part(name: str) -> str:
    """Return the part after the last slash of either kind."""
    return re.split(r"[/\\]", name)[-1]


def recording_name(name: str) -> str:
    """Return a recording's file name; what would be read as a file beside it gets another suffix.

    The stem, by which a flight goes, is kept where it is plain, and so is the suffix.
    """
    stem, _, ending = last_part(name).rpartition(".")
    if not stem or not re.fullmatch(r"\w{1,9}", ending, re.ASCII):
        stem, ending = last_part(name), ""
    suffix = f".{ending}" if ending else ""
    return file_name(stem, f"{suffix}_" if suffix.lower() in _SIDE_CARS else suffix)


def stems(names: Iterable[str]) -> list[str]:
    """Return the flights' names."""
    return [PurePosixPath(name).stem for name in names]


def shown_name(name: str) -> str:
    """Return a sender's file name for display: one short line without folders."""
    plain = "".join(c if c.isprintable() else "_" for c in last_part(name)).strip()
    return plain[:200] or "recording"
