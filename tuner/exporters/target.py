"""What an export target is, and what of a vehicle it does not hold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Literal

from tuner.coefficients import COEFFICIENTS, Coefficient, NotCarried, Written
from tuner.config import VehicleFile, values_of
from tuner.errors import ExportError, did_you_mean
from tuner.exporters import targets
from tuner.exporters.draft import Draft

Simulator = Literal["gazebo-classic", "gz-sim"]
Entry = Written | NotCarried


@dataclass(frozen=True)
class Choices:
    """What a user can choose about the file.

    Attributes
    ----------
    into
        The model to patch; None for a file of its own.
    simulator
        Whose plugins a snippet without a model is for.
    """

    into: Path | None = None
    simulator: Simulator = "gazebo-classic"


@dataclass(frozen=True)
class Target:
    """A format that a vehicle can be exported in.

    Attributes
    ----------
    name
        As `Coefficient.exported_as` has it.
    suffix
        Of its files.
    draft
        Vehicle, provenance in one line and choices -> the file before it is written, which knows
        how it is read back.
    entry
        Where the target holds a coefficient, or why it has no place for it; None for a coefficient
        about which nothing is registered.
    patches
        Whether it can go into a model that exists.
    """

    name: str
    suffix: str
    draft: Callable[[VehicleFile, str, Choices], Draft]
    entry: Callable[[Coefficient], Entry | None]
    patches: bool = False


def target_of(name: str) -> Target:
    """Return the target of a name.

    Raises
    ------
    ExportError
        There is none.
    """
    if name not in targets.NAMES:
        remedy = did_you_mean(name, targets.NAMES)
        raise ExportError("--format", f"unknown export format '{name}'", remedy)
    target: Target = import_module(f"{targets.__name__}.{name}").TARGET
    return target


def registered(target: str) -> Callable[[Coefficient], Entry | None]:
    """Return the `Target.entry` of a target whose entries stand in the registry."""
    return lambda coefficient: coefficient.exported_as.get(target)


def check_every_coefficient(vehicle: VehicleFile, target: Target) -> None:
    """Refuse a vehicle with a coefficient that a target would lose without a word.

    Raises
    ------
    ExportError
        A coefficient that is not at its neutral value is neither carried by the target nor named
        as not carried.
    """
    for name, value in values_of(vehicle).items():
        row = COEFFICIENTS[name]
        if target.entry(row) is None and value != row.neutral:
            raise ExportError(
                vehicle.name,
                f"{name} is {quantity(value, row)}, which --format {target.name} can neither write "
                "nor name as not exportable",
                f"give {name} an entry for {target.name} in the registry of coefficients",
            )


def not_carried(vehicle: VehicleFile, target: Target) -> tuple[str, ...]:
    """Return a sentence for each coefficient that a target has no place for and that acts."""
    sentences = []
    for name, value in values_of(vehicle).items():
        row = COEFFICIENTS[name]
        entry = target.entry(row)
        if isinstance(entry, NotCarried) and value not in (row.neutral, entry.built_in):
            sentences.append(f"{name} {quantity(value, row)} is not exported: {entry.reason}")
    return tuple(sentences)


def quantity(value: float, row: Coefficient) -> str:
    """Return a coefficient's value with its unit."""
    return f"{value:g} {row.unit}".strip()
