"""The coefficients of the model: the table that defines them and the space that a fit searches."""

from tuner.coefficients.coefficient import EFFECTS, Coefficient, NotCarried, Written
from tuner.coefficients.registry import (
    COEFFICIENTS,
    REGISTRY,
    conditions,
    of_scope,
    recording_offsets,
    scale_group,
    term_groups,
)

__all__ = [
    "COEFFICIENTS",
    "EFFECTS",
    "REGISTRY",
    "Coefficient",
    "NotCarried",
    "Written",
    "conditions",
    "of_scope",
    "recording_offsets",
    "scale_group",
    "term_groups",
]
