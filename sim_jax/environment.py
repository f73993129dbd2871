"""What surrounds a flight, and is no property of the vehicle."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float, Int, PyTree

from sim_jax.disturbance import Disturbance
from sim_jax.numeric import Array, Scalar
from sim_jax.schedule import Schedule
from sim_jax.trees import row_of
from sim_jax.vector import Vec3


class Environment(eqx.Module):
    """The surroundings of a flight; what is None is not there, and costs nothing."""

    wind: Vec3 | None = None
    """m/s, world ENU: the air's steady velocity over the ground, leaves (\\*batch)."""
    log_voltage: Float[Array, "ticks *batch"] | None = None
    """Logarithm of the battery's voltage over its reference voltage, one a control tick."""
    battery_decline: Scalar | None = None
    """1/s by which rotor speeds fall, where no voltage was recorded."""
    begin: Float[Array, "*batch"] | None = None
    """s since the battery began to decline at which the simulation begins; None for zero."""
    disturbance: Disturbance | None = None
    """Gusts, and whatever else pushes."""
    draught: Scalar | None = None
    """m/s, standard deviation along the rotors' axes of gusts of which no more is known: thrust is
    what they leave of it in the mean. None for still air."""

    @property
    def at_first(self) -> PyTree[Array]:
        """The values at the first control tick, every leaf (\\*batch)."""
        series = jax.tree.map(lambda values: values[0], (self.log_voltage, self.disturbance))
        return series, self.wind, self.battery_decline, self.begin, self.draught

    def during(self, step: Int[Array, ""], schedule: Schedule) -> Environment:
        """Return what surrounds the flight in a physics step: its gust is part of the wind."""
        if self.disturbance is None:
            return self
        now = self.disturbance.during(step, schedule)
        wind = self.wind
        if now.gust is not None:
            wind = now.gust if wind is None else wind + now.gust
        return replace(self, wind=wind, disturbance=now)

    def speed_factor(
        self, battery_exponent: Scalar | None, step: Int[Array, ""], schedule: Schedule
    ) -> Scalar | None:
        """Return the factor of the battery on reference rotor speeds in a step; None for none.

        (V/V_ref)^battery_exponent where the voltage is known (thesis 10.4), 1 - battery_decline·t
        where a flight's decline is.
        """
        factor: Scalar | None = None
        if battery_exponent is not None and self.log_voltage is not None:
            factor = jnp.exp(
                battery_exponent * row_of(self.log_voltage, schedule.control_tick(step))
            )
        if self.battery_decline is not None:
            time = step * schedule.step if self.begin is None else step * schedule.step + self.begin
            declined = 1.0 - self.battery_decline * time
            factor = declined if factor is None else factor * declined
        return factor


NOTHING_AROUND = Environment()
"""Still air."""
