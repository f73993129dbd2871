"""The side-car: what a lab notes about one recording, in a YAML file of the same name beside it."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError, field_validator

from tuner.errors import ConfigError, did_you_mean

#: Trajectories that a side-car can name.
TRAJECTORIES = ("circle", "lemniscate", "straight", "diagonal", "yaw_spin", "hover")
#: A longer side-car is none.
LONGEST = 1 << 16


class Sidecar(BaseModel):
    """What is said about a recording.

    Attributes
    ----------
    trajectory
        Name and parameters of what was flown, for recordings without the reference.
    start, end
        Seconds since the first pose between which the mission lies, instead of those found.
    topics, namespace
        The topic map of this recording, and the prefix of its topics.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    trajectory: Mapping[str, Any] | None = None
    start: float | None = None
    end: float | None = None
    topics: str | None = None
    namespace: str = ""

    @field_validator("trajectory")
    @classmethod
    def _named(cls, value: Mapping[str, Any] | None) -> Mapping[str, Any] | None:
        if value is not None and value.get("name") not in TRAJECTORIES:
            hint = did_you_mean(str(value.get("name")), TRAJECTORIES)
            raise ValueError(f"no trajectory is called '{value.get('name')}', {hint}")
        return value


def read_sidecar(recording: Path) -> Sidecar:
    """Read the side-car of a recording; an empty one where there is none.

    Raises
    ------
    ConfigError
        It is no valid side-car.
    """
    path = recording.with_suffix(".yaml") if recording.is_file() else recording / "flight.yaml"
    if not path.is_file() or path == recording:
        return Sidecar()
    try:
        if path.stat().st_size > LONGEST:
            raise ConfigError(path, "is too long for a side-car", "move it elsewhere")
        loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
        return Sidecar.model_validate(yaml.load(path.read_text(encoding="utf-8"), Loader=loader))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as err:
        said = re.sub(r"\s+", " ", str(err))[:150]
        raise ConfigError(path, f"is no readable side-car ({said})", "correct it") from None
    except ValidationError as err:
        detail = err.errors(include_url=False)[0]
        where = ".".join(str(part) for part in detail["loc"])
        said = detail["msg"].removeprefix("Value error, ")
        known = ", ".join(Sidecar.model_fields)
        raise ConfigError(path, f"{where}: {said}", f"a side-car knows {known}") from None
