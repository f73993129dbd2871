"""What a finished search is reported as."""

from types import SimpleNamespace

import jax.numpy as jnp
import pytest

from tuner.config import JobFile
from tuner.job.results import best_values
from tuner.objective.space import space_of
from tuner.vehicle import ControllerFile
from tuner.vehicle.controller import Filters


@pytest.mark.parametrize(("name", "initial"), [("gyro_cutoff", 30.0), ("fuselage_drag", 0.0)])
def test_what_the_vehicle_file_leaves_open_is_held_at_the_value_that_flies(name, initial, updated):
    controller = ControllerFile(filters=Filters(gyro_cutoff=30.0))
    space = space_of(updated, controller, JobFile(free=(name, "motor_constant")))
    settings = SimpleNamespace(vehicle=updated, controller=controller)
    point = SimpleNamespace(coefficients=jnp.asarray(space.initial + 0.5))
    values = best_values(
        SimpleNamespace(settings=settings, space=space),
        SimpleNamespace(point=point, held={name: name}),
    )
    assert values[name] == initial
    assert values["motor_constant"] > updated.aerodynamics.motor_constant
