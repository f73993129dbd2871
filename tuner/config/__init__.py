"""Vehicle, controller and job files: validated in one line, plain numbers, no simulator."""

from tuner.config.controller import ControllerFile, read_controller
from tuner.config.job import CHANNELS, JobFile, read_job
from tuner.config.settings import Options, Settings, find_job_file, settle
from tuner.config.values import check_names, initial_values, values_of, with_values
from tuner.config.vehicle import VehicleFile, check_mixer, read_vehicle, vehicle_text, write_vehicle
from tuner.trajectory_settings import TrajectorySettings
from tuner.yaml_files.shipped import configs_folder, find_config

__all__ = [
    "CHANNELS",
    "ControllerFile",
    "JobFile",
    "Options",
    "Settings",
    "TrajectorySettings",
    "VehicleFile",
    "check_mixer",
    "check_names",
    "configs_folder",
    "find_config",
    "find_job_file",
    "initial_values",
    "read_controller",
    "read_job",
    "read_vehicle",
    "settle",
    "values_of",
    "vehicle_text",
    "with_values",
    "write_vehicle",
]
