"""SDF of Gazebo classic, or of gz-sim: a model that exists patched, or the tags alone."""

from __future__ import annotations

from tuner.exporters.draft import Draft
from tuner.exporters.sdf.patch import sdf_draft, simulator_of
from tuner.exporters.sdf.snippet import snippet_draft
from tuner.exporters.simulators import GAZEBO_CLASSIC, GZ_SIM
from tuner.exporters.target import Choices, Target
from tuner.vehicle import VehicleFile


def sdf_or_snippet(vehicle: VehicleFile, provenance: str, choices: Choices) -> Draft:
    """Return a model with a vehicle's numbers, or the tags alone; a model says whose it is."""
    if choices.into is None:
        simulator = GZ_SIM if choices.simulator == GZ_SIM.name else GAZEBO_CLASSIC
        return snippet_draft(vehicle, simulator, provenance)
    return sdf_draft(choices.into, vehicle, provenance)


TARGET = Target(
    "sdf",
    ".sdf",
    sdf_or_snippet,
    GAZEBO_CLASSIC.entry,
    patches=True,
    simulator=GAZEBO_CLASSIC,
    others=(GZ_SIM,),
    detected=simulator_of,
)
