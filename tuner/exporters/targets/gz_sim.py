"""SDF of gz-sim, whose motor model differs from Gazebo classic's."""

from __future__ import annotations

from dataclasses import replace

from tuner.exporters.simulators import GZ_SIM
from tuner.exporters.target import Target
from tuner.exporters.targets.sdf import TARGET as SDF

TARGET: Target = replace(SDF.for_simulator(GZ_SIM.name), name="gz-sim", others=())
