"""How the loop flies where set-ups differ and controller files are often wrong: tried both ways."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import numpy as np

from sim_jax.control.gains import Controller
from sim_jax.numeric import Scalar
from tuner.objective.normal import Objective

GAIN = 1.2
"""The controller file's own choice is given up only for one that lowers the loss by this factor."""


FROM_START = ("sees_markers",)
"""Choices that the markers' coefficients take up while a hover is all that is seen: the other way
is tried from where the search began. From markers that meet a hover as it did not fly, it flies
worse than the wrong way, and no step leads out."""


class Loop(NamedTuple):
    """The choices, 1 or 0 each; named as the controller's leaves are.

    Attributes
    ----------
    saturation_feedback
        Whether the mixer desaturates and the rate integrator stops where rotors are clipped, as in
        PX4. A saturated yaw step shows it.
    sees_markers
        Whether position and attitude control see the motion capture's frame. A hover shows it: who
        sees a frame that is tilted keeps away from where it was sent.
    """

    saturation_feedback: float = 1.0
    sees_markers: float = 0.0

    def switched(self, choice: str) -> Loop:
        """Return the loop with one choice the other way."""
        return self._replace(**{choice: 1.0 - getattr(self, choice)})


USUAL = Loop()
"""PX4's, with an estimator that knows where the markers sit."""


def loop_of(objective: Objective) -> Loop:
    """Return how an objective's loop flies."""
    return Loop(*map(float, _leaves(objective.model.controller)))


def with_loop(objective: Objective, loop: Loop) -> Objective:
    """Return the objective whose loop flies so."""
    changed: Objective = eqx.tree_at(
        lambda o: _leaves(o.model.controller), objective, [np.asarray(choice) for choice in loop]
    )
    return changed


def _leaves(controller: Controller) -> list[Scalar]:
    return [controller.rate.saturation_feedback, controller.sees_markers]
