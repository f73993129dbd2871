"""SDF of Gazebo classic and gz-sim: a model that exists patched, or the tags alone."""

from __future__ import annotations

from tuner.config import VehicleFile
from tuner.exporters.draft import Draft
from tuner.exporters.sdf.patch import sdf_draft
from tuner.exporters.sdf.snippet import snippet_draft
from tuner.exporters.target import Choices, Target, registered


def _draft(vehicle: VehicleFile, provenance: str, choices: Choices) -> Draft:
    if choices.into is None:
        return snippet_draft(vehicle, choices.simulator, provenance)
    return sdf_draft(choices.into, vehicle, provenance)


TARGET = Target("sdf", ".sdf", _draft, registered("sdf"), patches=True)
