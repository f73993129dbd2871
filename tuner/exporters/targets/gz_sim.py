"""SDF of gz-sim, whose motor model computes otherwise than Gazebo classic's."""

from __future__ import annotations

from dataclasses import replace

from tuner.exporters.simulators import GZ_SIM
from tuner.exporters.target import Target
from tuner.exporters.targets.sdf import TARGET as SDF

TARGET: Target = replace(
    SDF,
    name="gz-sim",
    draft=lambda vehicle, provenance, choices: SDF.draft(
        vehicle, provenance, replace(choices, simulator=GZ_SIM.name)
    ),
    entry=GZ_SIM.entry,
    simulator=GZ_SIM,
    others=(),
)
