"""What an export target is, its file on the way out, and what of a vehicle it does not hold."""

from __future__ import annotations

import math
import re
from ast import Assign, Dict, Name, literal_eval, parse
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any

from tuner.core import shipped
from tuner.core.disk import whole_file
from tuner.core.errors import ConfigError, ExportError, did_you_mean
from tuner.core.files import read_bytes
from tuner.exporters import targets
from tuner.exporters.simulators import THIS_PROJECT, Simulator
from tuner.result import Gate
from tuner.vehicle import COEFFICIENTS, Coefficient, NotCarried, VehicleFile, values_of

MAX_BYTES = 10_000_000
#: Numbers are written with twelve digits; mass and inertia may go through sums of links.
TOLERANCE = 1e-9


@dataclass(frozen=True)
class Draft:
    """A file before it is written.

    Attributes
    ----------
    vehicle
        The vehicle as whoever reads the file will fly it.
    notes
        What was done, and what the format has no place for.
    faults
        Given the file as it stands on the disk, and which others stand in for theirs, what is wrong
        with the numbers in it.
    gates
        Conditions of the format's own.
    others
        Further files -> their text, where a model is split over several.
    flier
        Flies it in its own simulator, as of `tuner.exporters.flier.flier`; None where that is
        not installed.
    """

    text: str
    vehicle: VehicleFile
    notes: tuple[str, ...]
    faults: Callable[[Path, Mapping[Path, Path]], Sequence[str]]
    gates: tuple[Gate, ...] = ()
    others: Mapping[Path, str] = field(default_factory=dict)
    flier: Callable[..., Any] | None = None


def differences(wanted: Mapping[str, float], read: Mapping[str, float]) -> list[str]:
    """Return which of the wanted numbers, by name, a file does not hold, a sentence each."""
    return [
        f"{name} is {read[name]!r}, not {value!r}" if name in read else f"{name} is missing"
        for name, value in wanted.items()
        if name not in read or not math.isclose(read[name], value, rel_tol=TOLERANCE, abs_tol=1e-15)
    ]


def flattened(content: Mapping[str, Any]) -> dict[str, float]:
    """Return key and place -> number of tables and lists in each other; words are left out."""
    numbers: dict[str, float] = {}
    for name, value in content.items():
        if isinstance(value, Mapping):
            numbers |= flattened({f"{name}.{key}": item for key, item in value.items()})
        elif isinstance(value, list):
            numbers |= flattened({f"{name}[{i}]": item for i, item in enumerate(value)})
        elif not isinstance(value, str):
            numbers[name] = float(value)
    return numbers


def assigned(path: Path) -> dict[str, Any]:
    """Return what a Python module that was written here assigns: name -> value; nothing is run."""
    return {
        statement.targets[0].id: literal_eval(statement.value)
        for statement in parse(read_file(path)).body
        if isinstance(statement, Assign) and isinstance(statement.targets[0], Name)
        if not isinstance(statement.value, Dict) or None not in statement.value.keys
    }


def xml_comment(text: str) -> str:
    """Return a line as an XML comment may hold it, in a Jinja template too."""
    return re.sub(r"-(?=-)|\{(?=[{%#])", r"\g<0> ", text)


def write(draft: Draft, path: Path, others: Mapping[Path, Path] | None = None) -> None:
    """Write a draft if it reads back as what it should hold; otherwise all stays as it was.

    Parameters
    ----------
    path
        Where to; it appears whole.
    others
        Further file of the draft -> where it is written instead; None writes it where it is.

    Raises
    ------
    ExportError
        It does not hold what it should.
    OutputError
        It cannot be written.
    """
    with ExitStack() as stack:

        def written(place: Path, text: str) -> Path:
            unfinished = stack.enter_context(whole_file(place))
            unfinished.write_text(text, encoding="utf-8", newline="")
            return unfinished

        first = written(path, draft.text)
        instead = {
            file: written((others or {}).get(file, file), text)
            for file, text in draft.others.items()
        }
        if wrong := draft.faults(first, instead):
            raise ExportError(
                path, f"would not read back: {'; '.join(wrong)}", "report this; nothing was written"
            )


def read_file(path: Path) -> str:
    """Read a text file of a simulator.

    Raises
    ------
    ExportError
        It is missing, too large, or no text.
    """
    try:
        return read_bytes(path, most=MAX_BYTES, remedy="give a model file").decode("utf-8")
    except ConfigError as error:
        raise ExportError(path, error.what, error.remedy) from None
    except UnicodeDecodeError:
        raise ExportError(path, "is not UTF-8 text", "give a model file") from None


@dataclass(frozen=True)
class Target:
    """A format that a vehicle can be exported in.

    Attributes
    ----------
    name
        As `Coefficient.exported_as` has it.
    draft
        Vehicle, provenance in one line, simulator, and the model to patch, or None for a file of
        its own -> the file before it is written, which knows how it is read back.
    simulator
        Who flies what it holds.
    others
        Further simulators that read the format.
    simulator_of
        A model to patch -> the name of the simulator that it is for; None for a format that goes
        into no model that exists.
    """

    name: str
    suffix: str
    draft: Callable[[VehicleFile, str, Simulator, Path | None], Draft]
    simulator: Simulator = THIS_PROJECT
    others: tuple[Simulator, ...] = ()
    simulator_of: Callable[[Path], str] | None = None

    def for_simulator(self, simulator: str = "", into: Path | None = None) -> Target:
        """Return the target for the simulator that is asked for, or that a model is for.

        Raises
        ------
        ExportError
            It patches no model, has nothing for that simulator, or the model is for another one.
        """
        known = {s.name: s for s in (self.simulator, *self.others) if s.name}
        is_for = ""
        if into is not None:
            if self.simulator_of is None:
                raise ExportError(
                    "--into", f"does not go with --format {self.name}", "leave it out"
                )
            is_for = self.simulator_of(into)
        for what, name in (("--simulator", simulator), (str(into), is_for)):
            if name and name not in known:
                raise ExportError(
                    what,
                    f"--format {self.name} is not for {name}",
                    f"it is for {' or '.join(known) or THIS_PROJECT.title}",
                )
        if is_for and simulator and simulator != is_for:
            raise ExportError(
                str(into), f"is a model for {is_for}", f"leave --simulator {is_for} out"
            )
        return replace(self, simulator=known.get(is_for or simulator, self.simulator))


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
        if target.simulator.entry(row) is None and value != row.neutral:
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
        entry = target.simulator.entry(row)
        if not isinstance(entry, NotCarried):
            continue
        same = (at for at in (row.neutral, entry.built_in) if at is not None)
        # a bound is reached to the last digits
        if not any(math.isclose(value, at, abs_tol=1e-9 * row.step) for at in same):
            sentences.append(f"{name} {quantity(value, row)} is not exported: {entry.reason}")
    return tuple(sentences)


def quantity(value: float, row: Coefficient) -> str:
    """Return a coefficient's value with its unit."""
    return f"{value:g} {row.unit}".strip()
