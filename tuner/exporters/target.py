"""What an export target is, and what of a vehicle it does not hold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path

from tuner.core import shipped
from tuner.core.errors import ExportError, did_you_mean
from tuner.exporters import targets
from tuner.exporters.draft import Draft
from tuner.exporters.simulators import Entry, Simulator
from tuner.vehicle import COEFFICIENTS, Coefficient, NotCarried, VehicleFile, values_of


@dataclass(frozen=True)
class Choices:
    """What a user can choose about the file.

    Attributes
    ----------
    into
        The model to patch; None for a file of its own.
    simulator
        Which of a format's simulators it is for; empty for its usual one.
    """

    into: Path | None = None
    simulator: str = ""


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
    simulator
        Who flies what it holds; None for this project.
    others
        Further simulators that read the format.
    detected
        A model to patch -> the name of the simulator that it is for.
    """

    name: str
    suffix: str
    draft: Callable[[VehicleFile, str, Choices], Draft]
    entry: Callable[[Coefficient], Entry | None]
    patches: bool = False
    simulator: Simulator | None = None
    others: tuple[Simulator, ...] = ()
    detected: Callable[[Path], str] | None = None

    @property
    def simulator_name(self) -> str:
        """Of who flies it; empty for this project."""
        return "" if self.simulator is None else self.simulator.name

    def chosen(self, choices: Choices) -> Target:
        """Return the target for the simulator that is asked for, or that a model is for.

        Raises
        ------
        ExportError
            It patches no model, has nothing for that simulator, or the model is for another one.
        """
        if choices.into is not None and not self.patches:
            raise ExportError("--into", f"does not go with --format {self.name}", "leave it out")
        known = {s.name: s for s in (self.simulator, *self.others) if s is not None}
        is_for = ""
        if choices.into is not None and self.detected is not None:
            is_for = self.detected(choices.into)
        for what, name in (("--simulator", choices.simulator), (str(choices.into), is_for)):
            if name and name not in known:
                raise ExportError(
                    what,
                    f"--format {self.name} is not for {name}",
                    f"it is for {' or '.join(known) or 'this project'}",
                )
        if is_for and choices.simulator and choices.simulator != is_for:
            raise ExportError(
                str(choices.into), f"is a model for {is_for}", f"leave --simulator {is_for} out"
            )
        simulator = known.get(is_for or choices.simulator)
        if simulator is None or simulator is self.simulator:
            return self
        return replace(self, simulator=simulator, entry=simulator.entry)

    def flown(self, vehicle: VehicleFile) -> VehicleFile:
        """Return the vehicle as whoever reads the file flies it."""
        return vehicle if self.simulator is None else self.simulator.flown(vehicle)


def target_of(name: str) -> Target:
    """Return the target of a name.

    Raises
    ------
    ExportError
        There is none.
    """
    if name not in shipped.EXPORT_TARGETS:
        remedy = did_you_mean(name, shipped.EXPORT_TARGETS)
        raise ExportError("--format", f"unknown export format '{name}'", remedy)
    target: Target = import_module(f"{targets.__name__}.{name.replace('-', '_')}").TARGET
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
