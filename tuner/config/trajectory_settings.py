"""Which trajectory was or is to be flown: of a recording without its reference, or to simulate."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator

from tuner.core.yaml_section import Number, Positive, Section, refuse


def _of_a_shape(name: str) -> str:
    from sim_jax.trajectory import shapes  # noqa: PLC0415 (loads JAX, which most commands spare)

    if name not in shapes():
        raise refuse(f"there is no trajectory '{name}'", f"name one of {', '.join(shapes())}")
    return name


TrajectoryName = Annotated[str, AfterValidator(_of_a_shape)]


class TrajectorySettings(Section):
    """The trajectory of a recording that holds no reference; keys and units of ``tune simulate``.

    Attributes
    ----------
    name
        Which shape.
    radius
        m.
    omega
        rad/s.
    speed_scale
        The publisher's velocity scaler.
    yaw_rate
        rad/s, of a yaw spin.
    """

    name: TrajectoryName
    radius: Positive = 2.0
    omega: Positive = 0.7
    speed_scale: Positive = 2.1
    yaw_rate: Number = 2.0
