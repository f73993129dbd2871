"""``tune compare``: the RMSE table of several coefficient sets."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tuner.cli.options import EACH, Quiet
from tuner.options import Options, RecordingOptions

if TYPE_CHECKING:
    from tuner.evaluate.rmse import FlightErrors


def compare(
    *,
    recordings: Annotated[RecordingOptions, EACH],
    vehicle: list[str],
    out: list[Path] | None = None,
    laps: bool = False,
    plot: Path | None = None,
    quiet: Quiet = False,
) -> None:
    """Simulate the recorded flights with several coefficient sets and tabulate the RMSE.

    Parameters
    ----------
    vehicle
        Compare these vehicle files, or shipped vehicles by their names.
    out
        Write the table into these files: .csv, .json or .html.
    laps
        Show each lap on the terminal, too.
    plot
        Draw the position errors over time into this FILE.png, .svg or .pdf.
    """
    from tuner.cli.progress import listening
    from tuner.cli.tables import print_comparison
    from tuner.core.runtime import configure

    configure()
    from tuner.evaluate.compare import compare as compare_vehicles
    from tuner.report.figures import comparison_figure
    from tuner.report.paper import check_figure, write_figure

    written = list(out or ())
    if plot is not None:
        check_figure(plot)
        written.append(plot)

    def draw(flown: Mapping[str, Mapping[str, FlightErrors]]) -> None:
        if plot is not None:
            write_figure(comparison_figure(flown), plot)

    options = Options(**vars(recordings))
    with listening(quiet=quiet, verbose=True) as listener:
        table, settings = compare_vehicles(
            options, vehicle, out or (), on_flown=draw, on_message=listener.on_message
        )
    if not quiet:
        print_comparison(table, settings, laps=laps, written=written)
