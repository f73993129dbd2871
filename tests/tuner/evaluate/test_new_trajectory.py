"""A trajectory is one place: a subclass of `Shape`, here in a module made for the test."""

import importlib
import sys

import numpy as np
import pytest

from sim_jax.trajectory import Shape
from tuner.cli import main
from tuner.design.ranking import Arena, candidates

SQUIRCLE = '''
"""A rounded square."""

import jax.numpy as jnp

from sim_jax.trajectory import Shape
from sim_jax.geometry import Vec3


class Squircle(Shape):
    name = "squircle"
    peak_speed = 1.5
    peak_acceleration = 2.0
    extent = (1.25, 1.25)

    def position(self, angle):
        x = jnp.cos(angle) + 0.25 * jnp.cos(3 * angle)
        y = jnp.sin(angle) + 0.25 * jnp.sin(3 * angle)
        return Vec3(self.radius * x, self.radius * y, jnp.zeros_like(angle)) + self.origin
'''


@pytest.fixture
def squircle(tmp_path, monkeypatch):
    """Write the module and import it; it is gone after the test."""
    (tmp_path / "squircle_module.py").write_text(SQUIRCLE)
    monkeypatch.syspath_prepend(tmp_path)
    before = Shape.__subclasses__()
    shape = importlib.import_module("squircle_module").Squircle
    yield shape
    del sys.modules["squircle_module"]
    Shape.__subclasses__ = lambda: before  # the class itself outlives the test in JAX's caches


def test_a_new_trajectory_is_simulated_and_proposed(squircle, tmp_path, capsys):
    out = tmp_path / "flight.csv"
    flown = ["simulate", "--trajectory", "squircle", "--radius", "1", "--speed", "1"]
    assert main([*flown, "--duration", "4", "--out", str(out)]) == 0
    table = np.genfromtxt(out, delimiter=",", names=True)
    assert table["ref_x"][0] == pytest.approx(1.25)
    assert abs(table["x"] - table["ref_x"]).max() < 0.2
    names = [*candidates(Arena(8.0, 6.0, 3.0))]
    assert "a squircle of 2 m radius at 1.5 m/s" in names
    capsys.readouterr()
    assert main(["simulate", "--trajectory", "square", "--out", str(out)]) == 2
    assert squircle.name in capsys.readouterr().err
