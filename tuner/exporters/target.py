"""Export targets: their files, written and read back, and the coefficients that they lack."""

from __future__ import annotations

import math
import re
from ast import Assign, Dict, Name, literal_eval, parse
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any

from tuner.core import shipped
from tuner.core.disk import read_bytes, whole_file
from tuner.core.errors import ConfigError, ExportError, did_you_mean
from tuner.exporters import targets
from tuner.exporters.simulators import THIS_PROJECT, Simulator
from tuner.result import Gate
from tuner.vehicle import COEFFICIENTS, Coefficient, NoExportTag, VehicleFile, values_of

MAX_BYTES = 10_000_000
#: Relative. Numbers are written with twelve digits; mass and inertia are sums over links.
TOLERANCE = 1e-9
PLACE_TOLERANCE_M = 0.005
"""Rotors that are nearer to their place in a vehicle file, or to a square, are there."""


@dataclass(frozen=True)
class Draft:
    """A file before it is written.

    Attributes
    ----------
    vehicle
        The vehicle as the file's reader flies it.
    notes
        Remarks, and coefficients that the format lacks.
    faults
        The file on the disk, and further file -> its stand-in -> wrong numbers, a sentence each.
    gates
        Conditions of the format's own.
    others
        Further file of a split model -> its text.
    flier
        Flies segments in its own simulator (`tuner.exporters.external_simulator.flier_of`); None
        if that is not installed.
    """

    text: str
    vehicle: VehicleFile
    notes: tuple[str, ...]
    faults: Callable[[Path, Mapping[Path, Path]], Sequence[str]]
    gates: tuple[Gate, ...] = ()
    others: Mapping[Path, str] = field(default_factory=dict)
    flier: Callable[..., Any] | None = None


def differences(wanted: Mapping[str, float], read: Mapping[str, float]) -> list[str]:
    """Return a sentence for each wanted number, by name, that a file does not hold."""
    return [
        f"{name} is {read[name]!r}, not {value!r}" if name in read else f"{name} is missing"
        for name, value in wanted.items()
        if name not in read or not math.isclose(read[name], value, rel_tol=TOLERANCE, abs_tol=1e-15)
    ]


def flatten(content: Mapping[str, Any]) -> dict[str, float]:
    """Return path -> number of nested tables and lists, without strings."""
    numbers: dict[str, float] = {}
    for name, value in content.items():
        if isinstance(value, Mapping):
            numbers |= flatten({f"{name}.{key}": item for key, item in value.items()})
        elif isinstance(value, list):
            numbers |= flatten({f"{name}[{i}]": item for i, item in enumerate(value)})
        elif not isinstance(value, str):
            numbers[name] = float(value)
    return numbers


def module_assignments(path: Path) -> dict[str, Any]:
    """Return the assignments, name -> value, of an exported Python module, without running it."""
    return {
        statement.targets[0].id: literal_eval(statement.value)
        for statement in parse(read_file(path)).body
        if isinstance(statement, Assign) and isinstance(statement.targets[0], Name)
        if not isinstance(statement.value, Dict) or None not in statement.value.keys
    }


def numbers_draft(
    numbers: Callable[[VehicleFile], Mapping[str, Any]],
    text: Callable[[VehicleFile, str], str],
    read: Callable[[Path], Mapping[str, Any]],
    *,
    gates: Callable[[VehicleFile], tuple[Gate, ...]] = lambda _: (),
    flier: Callable[[VehicleFile], Callable[..., Any] | None] = lambda _: None,
) -> Callable[..., Draft]:
    """Return the `Target.draft` of a format whose file holds nested numbers.

    Parameters
    ----------
    numbers
        The vehicle by its simulator's laws -> the numbers that its file must hold.
    text
        That vehicle, and provenance in one line -> the file.
    read
        A file -> the numbers that it holds.
    gates
        The vehicle -> conditions of the format's own.
    flier
        The vehicle by its simulator's laws -> `Draft.flier`.
    """

    def draft(vehicle: VehicleFile, provenance: str, simulator: Simulator, _: object) -> Draft:
        flown = simulator.flown(vehicle)
        wanted = flatten(numbers(flown))
        return Draft(
            text(flown, provenance),
            flown,
            (),
            lambda path, _: differences(wanted, flatten(read(path))),
            gates(vehicle),
            flier=flier(flown),
        )

    return draft


def xml_comment(text: str) -> str:
    """Return a line that an XML comment, and a Jinja template, may hold."""
    return re.sub(r"-(?=-)|\{(?=[{%#])", r"\g<0> ", text)


def write(draft: Draft, path: Path, others: Mapping[Path, Path] | None = None) -> None:
    """Write a draft if it reads back right; otherwise change nothing.

    Parameters
    ----------
    path
        The file, written atomically.
    others
        Further file of the draft -> the path to write it to; None overwrites them.

    Raises
    ------
    ExportError
        It does not read back right.
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
    """A format of exports.

    Attributes
    ----------
    name
        Its key in `Coefficient.exported_as`.
    draft
        Vehicle, provenance in one line, simulator, and the model to patch or None -> the draft.
    simulator
        The simulator that flies it.
    others
        Further simulators that read the format.
    simulator_of
        A model to patch -> the name of its simulator; None for a format that patches no model.
    """

    name: str
    suffix: str
    draft: Callable[[VehicleFile, str, Simulator, Path | None], Draft]
    simulator: Simulator = THIS_PROJECT
    others: tuple[Simulator, ...] = ()
    simulator_of: Callable[[Path], str] | None = None

    def for_simulator(self, simulator: str = "", into: Path | None = None) -> Target:
        """Return the target for a named simulator, or for that of a model.

        Files for another than its first simulator are called after that, too.

        Raises
        ------
        ExportError
            It patches no model, does not support the simulator, or the model is for another.
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
        chosen = known.get(is_for or simulator, self.simulator)
        suffix = self.suffix if chosen is self.simulator else f"_{chosen.name}{self.suffix}"
        return replace(self, simulator=chosen, suffix=suffix)


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
    """Refuse a vehicle with a coefficient that a target would drop silently.

    Raises
    ------
    ExportError
        A coefficient that is not neutral has no entry for the target.
    """
    for name, value in values_of(vehicle).items():
        row = COEFFICIENTS[name]
        if target.simulator.entry(row) is None and value != row.neutral:
            raise ExportError(
                vehicle.name,
                f"{name} is {with_unit(value, row)}, which --format {target.name} can neither "
                "write nor name as not exportable",
                f"give {name} an entry for {target.name} in the registry of coefficients",
            )


def not_carried(vehicle: VehicleFile, target: Target) -> Iterator[str]:
    """Yield a sentence for each coefficient that acts and that a target lacks."""
    for name, value in values_of(vehicle).items():
        row = COEFFICIENTS[name]
        entry = target.simulator.entry(row)
        if not isinstance(entry, NoExportTag):
            continue
        same = (at for at in (row.neutral, entry.built_in) if at is not None)
        # a bound may differ in the last digits
        if not any(math.isclose(value, at, abs_tol=1e-9 * row.step) for at in same):
            yield f"{name} {with_unit(value, row)} is not exported: {entry.reason}"


def with_unit(value: float, row: Coefficient) -> str:
    """Return a coefficient's value with its unit."""
    return f"{value:g} {row.unit}".strip()
