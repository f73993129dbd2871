"""SDF of gz-sim, whose motor model computes otherwise than Gazebo classic's."""

from __future__ import annotations

from dataclasses import replace

from tuner.exporters.draft import Draft
from tuner.exporters.simulators import GZ_SIM
from tuner.exporters.target import Choices, Target
from tuner.exporters.targets.sdf import TARGET as SDF
from tuner.vehicle import VehicleFile


def _draft(vehicle: VehicleFile, provenance: str, choices: Choices) -> Draft:
    return SDF.draft(vehicle, provenance, replace(choices, simulator=GZ_SIM.name))


TARGET: Target = replace(
    SDF, name="gz-sim", draft=_draft, entry=GZ_SIM.entry, simulator=GZ_SIM, others=()
)
