"""The results of a run, or of an examination, as tables on the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from tuner.cli.tables import columns_of, console
from tuner.result import RMSE_UNITS

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from tuner.evaluate.cross_validation import Fold
    from tuner.ground.job import BenchResult
    from tuner.job.sensitivity import SensitivityResult
    from tuner.result import AxesRmse, EffectiveResult, RunResult
    from tuner.search.point_estimate import PointEstimate

RMSE_COLUMNS = [f"{axis} {unit}" for axis, unit in RMSE_UNITS.items()]
NOT_SIMULATED = "–"
"""Of what a simulation follows as it was recorded, or nobody recorded."""


def print_run(folder: Path, result: RunResult) -> None:
    """Print the coefficients, the RMSE before and after, what to log, and where everything lies."""
    from tuner.wording.proposals import next_log_in_words
    from tuner.wording.result import ending_sentence, refits_in_words, starts_in_words

    screen = console()
    screen.print(_coefficients(result))
    if result.selection:
        _print_selection(screen, result)
    if result.effective is not None:
        _print_effective(screen, result, result.effective)
    if said := refits_in_words(result):
        screen.print(_refits(result))
        screen.print(" ".join(said), markup=False)
    screen.print(_errors(result))
    for line in starts_in_words(result.flights):
        screen.print(line, markup=False)
    if any(flight.predicted_best for flight in result.flights):
        screen.print(_predictions(result))
    for line in next_log_in_words(result.next_log):
        screen.print(line, markup=False)
    search = result.search
    screen.print(
        f"{ending_sentence(search.message)} It took {search.evaluations} Jacobians and "
        f"{search.wall_time:.0f} s."
    )
    vehicles = "best_fit.yaml" if result.effective is None else "best_fit.yaml, effective.yaml"
    screen.print(
        f"written to {folder}/ (report.html, {vehicles}, result.json, metrics.csv, "
        "sensitivity.csv)",
        markup=False,
    )


def print_bench(bench: BenchResult) -> None:
    """Print what each experiment and all together say, and where everything lies."""
    from tuner.ground.bench_json import bench_record
    from tuner.wording.bench import agreement_in_words, numbers_in_words
    from tuner.wording.findings import one_line

    screen = console()
    record = bench_record(bench.combination, bench.measurements)
    for experiment in record.experiments:
        screen.print(f"{experiment.name}: {'; '.join(numbers_in_words(experiment))}", markup=False)
    screen.print(_coefficients(bench.result))
    screen.print(agreement_in_words(record))
    for finding in bench.result.findings:
        screen.print(one_line(finding), markup=False)
    screen.print(
        f"written to {bench.folder}/ (report.html, best_fit.yaml, result.json, bench.json)",
        markup=False,
    )


def print_sensitivity(result: SensitivityResult) -> None:
    """Print what is known of each coefficient, what to fly next, and where everything lies."""
    from tuner.wording.findings import one_line
    from tuner.wording.proposals import proposals_in_words
    from tuner.wording.verdicts import direction_in_words, judgement_in_words

    screen = console()
    then = ("unit", "+1 % moves position by", "how well it is known")
    table = columns_of("Coefficients", left=("coefficient",), right=("value", "±"), then=then)
    for name, known in result.knowledge.coefficients.items():
        error = "" if known.std_error is None else f"{known.std_error:.2g}"
        judgement = judgement_in_words(known.verdict, known.reason)
        table.add_row(
            known.label(name),
            f"{known.value:.5g}",
            error,
            known.unit,
            _largest_change(result, name),
            judgement,
        )
    screen.print(table)
    for finding in result.findings:
        screen.print(one_line(finding), markup=False)
    for direction in result.knowledge.directions[:1]:
        screen.print(
            f"The worst determined combination of coefficients: {direction_in_words(direction)}"
        )
    for sentence in proposals_in_words(result.proposals) if result.proposals else ():
        screen.print(sentence)
    screen.print(f"written to {result.folder}/ (report.html, sensitivity.csv, correlation.csv, …)")


def _largest_change(result: SensitivityResult, name: str) -> str:
    """Return the largest RMS change of a position axis, and where."""
    changes = [
        (output.change[name], output.axis, output.flight)
        for output in result.knowledge.outputs
        if output.channel == "position" and name in output.change
    ]
    if not changes:
        return ""
    change, axis, flight = max(changes)
    return f"{1000 * change:.3g} mm ({axis}, {flight})"


def _coefficients(result: RunResult) -> Table:
    from tuner.wording.verdicts import judgement_in_words

    numbers, then = ("initial", "best", "±"), ("unit", "how well it is known")
    table = columns_of("Coefficients", left=("coefficient",), right=numbers, then=then)
    for name, coefficient in result.coefficients.items():
        table.add_row(
            name,
            f"{coefficient.initial:.5g}",
            f"{coefficient.best:.5g}",
            "" if coefficient.std_error is None else f"{coefficient.std_error:.2g}",
            coefficient.unit,
            judgement_in_words(coefficient.verdict, coefficient.reason),
        )
    return table


def _refits(result: RunResult) -> Table:
    """Return the standard errors of the fit beside those of refits to other flights."""
    errors_of = ("this fit", "jackknife", "bootstrap")
    table = columns_of("Standard errors by refits", left=("coefficient",), right=errors_of)
    for name, found in result.coefficients.items():
        errors = (found.std_error, found.jackknife_error, found.bootstrap_error)
        if found.fitted:
            table.add_row(name, *("" if error is None else f"{error:.2g}" for error in errors))
    return table


def _print_selection(screen: Console, result: RunResult) -> None:
    """Print what each group of terms beyond the base model is worth."""
    from tuner.wording.result import gain_in_words, reason_in_words, selection_in_words

    gains_in, then = ("gain in the fit", "gain held out"), ("in the model", "why")
    table = columns_of("Terms beyond the motor model", left=("term",), right=gains_in, then=then)
    for row in result.selection:
        gains = gain_in_words(row.gain_fit), gain_in_words(row.gain_holdout)
        table.add_row(row.group, *gains, "yes" if row.kept else "no", reason_in_words(row))
    screen.print(table)
    screen.print(selection_in_words(result.selection), markup=False)


def _print_effective(screen: Console, result: RunResult, effective: EffectiveResult) -> None:
    """Print with which coefficients Gazebo flies most like the vehicle, where they differ."""
    from tuner.wording.result import effective_in_words, rmse_in_words

    answers = ("physical", "effective")
    table = columns_of("In Gazebo", left=("coefficient",), right=answers, then=("unit",))
    for name, value in effective.coefficients.items():
        row = result.coefficients.get(name)
        if row is not None and value != row.best:
            table.add_row(name, f"{row.best:.5g}", f"{value:.5g}", row.unit)
    screen.print(table)
    screen.print(effective_in_words(effective), markup=False)
    for term in effective.lost:
        missed = rmse_in_words(term.rmse_without)
        screen.print(f"Without {term.group} alone: {missed}.", markup=False)


def _errors(result: RunResult) -> Table:
    title = "RMSE with the initial → with the best coefficients"
    table = columns_of(title, left=("flight",), right=RMSE_COLUMNS)
    for flight in result.flights:
        cells = []
        for axis in RMSE_UNITS:
            both = [_axis(rmse, axis) for rmse in (flight.rmse_initial, flight.rmse_best)]
            cells.append(NOT_SIMULATED if both == [NOT_SIMULATED] * 2 else " → ".join(both))
        held_out = " (held out)" if flight.split == "holdout" else ""
        table.add_row(flight.name + held_out, *cells)
    return table


def _predictions(result: RunResult) -> Table:
    """Return the open-loop predictions' errors, before and after the fit."""
    from tuner.wording.result import PREDICTED

    title = (
        "Open-loop predictions from recorded states: mean error, initial → best coefficients (of a "
        "state that stays)"
    )
    errors = [f"{name.replace('_', ' ')} {unit}" for name, unit in PREDICTED.items()]
    table = columns_of(title, left=("flight",), right=("after", *errors))
    for flight in result.flights:
        held_out = " (held out)" if flight.split == "holdout" else ""
        rows = zip(
            flight.predicted_initial,
            flight.predicted_best,
            flight.predicted_holding or (None,) * len(flight.predicted_best),
            strict=True,
        )
        for before, after, held in rows:
            cells = [
                NOT_SIMULATED
                if getattr(before, name) is None and getattr(after, name) is None
                else f"{_number(getattr(before, name))} → {_number(getattr(after, name))}"
                + ("" if held is None else f" ({_number(getattr(held, name))})")
                for name in PREDICTED
            ]
            table.add_row(flight.name + held_out, f"{after.seconds:g} s", *cells)
    return table


def estimates_table(estimates: Sequence[PointEstimate]) -> Table:
    """Return where a search ended, of which nothing is known yet but the values."""
    table = columns_of(left=("coefficient",), right=("initial", "estimate"))
    table.add_column("unit")
    for row in estimates:
        table.add_row(row.name, f"{row.initial:.5g}", f"{row.estimate:.5g}", row.unit)
    return table


def folds_table(folds: Sequence[Fold]) -> Table:
    """Return how well each flight is predicted by the fit to the others."""
    title = "RMSE of each flight with the fit to the others"
    table = columns_of(title, left=("left out",), right=RMSE_COLUMNS)
    for fold in folds:
        cells = [
            "impossible" if fold.rmse is None else _axis(fold.rmse, axis) for axis in RMSE_UNITS
        ]
        table.add_row(fold.left_out, *cells)
    return table


def _axis(rmse: AxesRmse, axis: str) -> str:
    """Return an axis' RMSE; of a flight whose attitude is followed three axes are not simulated."""
    flown = any(getattr(rmse, each) is not None for each in RMSE_UNITS)
    value = getattr(rmse, axis)
    return NOT_SIMULATED if flown and value is None else _number(value)


def _number(value: float | None) -> str:
    return "crash" if value is None else f"{value:.4f}" if value < 0.1 else f"{value:.3f}"
