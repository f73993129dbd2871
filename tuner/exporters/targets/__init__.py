"""The export targets: each module here is one, under the name that ``--format`` takes.

To add a target, add a module with a `Target` of the name ``TARGET``: what it can carry, how it is
written and how it is read back.
"""

from __future__ import annotations

import pkgutil
from importlib import import_module
from typing import TYPE_CHECKING

from tuner.errors import ExportError, did_you_mean

if TYPE_CHECKING:
    from tuner.exporters.target import Target

NAMES = [module.name for module in pkgutil.iter_modules(__path__)]
"""Of the targets."""


def target_of(name: str) -> Target:
    """Return the target of a name.

    Raises
    ------
    ExportError
        There is none.
    """
    if name not in NAMES:
        raise ExportError("--format", f"unknown export format '{name}'", did_you_mean(name, NAMES))
    found: Target = import_module(f"{__name__}.{name}").TARGET
    return found
