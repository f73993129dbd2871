"""The job file and the settings of a job: validated in one line, plain values."""

from __future__ import annotations

from tuner.config.job import CHANNELS, JobFile, TrajectorySettings, read_job
from tuner.config.settings import Settings, find_job_file, resolve_settings
from tuner.options import Options

__all__ = [
    "CHANNELS",
    "JobFile",
    "Options",
    "Settings",
    "TrajectorySettings",
    "find_job_file",
    "read_job",
    "resolve_settings",
]
