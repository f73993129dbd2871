"""How large a vehicle is, and what is usual for a coefficient of a vehicle that large.

A small vehicle flies as a large one does with all lengths, masses and times in proportion: forces
go with its weight m g, moments with m g l, and times with √(l/g) (similarity after Froude;
Wolowicz, Bowman and Gilbert, "Similitude requirements and scaling relationships as applied to model
testing", NASA TP-1435, 1979). So the drag of a vehicle of 30 g that would be unusual is a drag that
one of 2 kg has unnoticed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tuner.vehicle import VehicleFile
from tuner.vehicle.coefficient import Coefficient

MASS, ARM = 2.079, 0.25
"""kg, and m from the middle to a rotor, of the vehicle that the registry's numbers are made for."""


@dataclass(frozen=True)
class Size:
    """Mass and arm of a vehicle over those of the registry's."""

    mass: float = 1.0
    arm: float = 1.0


def size_of(vehicle: VehicleFile) -> Size:
    """Return how large a vehicle is."""
    arm = float(np.mean([np.hypot(*rotor.position[:2]) for rotor in vehicle.rotors]))
    return Size(vehicle.mass / MASS, arm / ARM)


def sized(row: Coefficient, size: Size) -> Coefficient:
    """Return a coefficient's row with bounds, prior and step as they are for a vehicle's size.

    Logarithms need none: their limits are factors.
    """
    if row.scale == "log":
        return row
    ratio = size.mass**row.mass_exponent * size.arm**row.length_exponent
    bounds = row.bounds
    if isinstance(bounds, tuple):
        bounds = (bounds[0] * ratio, bounds[1] * ratio)
    return replace(row, bounds=bounds, prior_sd=row.prior_sd * ratio, step=row.step * ratio)
