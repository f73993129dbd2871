"""Charts as files: SVG for papers, or as what a path ends in; and those of single commands."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tuner.core.disk import check_file, file_name, inside, make_folder, whole_file
from tuner.core.errors import InputError
from tuner.report.section import (
    FITTED,
    GREY,
    MIN_DRAWN,
    PALETTE,
    RECORDED,
    Bars,
    Chart,
    HeatMap,
    Line,
    LineStyle,
    Panel,
    rounded,
)
from tuner.result import PLOTS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

    from tuner.evaluate.closed_loop import Simulation
    from tuner.evaluate.comparison import FlightErrors


MAX_COLUMNS = 8
"""Flights that a figure compares: more panels cannot be read."""


def flight_figure(flight: Simulation, title: str) -> Chart:
    """Return a simulated flight: position beside its reference, tilt, rotor speeds, over time."""
    time, signals = rounded(flight.time, 4), flight.signals
    panels = [
        Panel(
            [
                Line("reference", time, rounded(signals["reference_position"][:, n], 5), RECORDED),
                Line("flown", time, rounded(signals["position"][:, n], 5), FITTED),
            ],
            y_title=f"{axis} [m]",
        )
        for n, axis in enumerate("xyz")
    ]
    speed = np.linalg.norm(signals["velocity"], axis=1)
    panels.append(
        Panel([Line("speed", time, rounded(speed, 4), LineStyle(PALETTE[2]))], "speed [m/s]")
    )
    rotors = [
        Line(
            f"rotor {n + 1}",
            time,
            rounded(column, 2),
            LineStyle(PALETTE[n % len(PALETTE)], width=1.0),
        )
        for n, column in enumerate(signals["rotor_speed"].T)
    ]
    panels.append(Panel(rotors, y_title="rotors [rad/s]"))
    return Chart("flight", title, panels, x_title="time [s]", height=820)


def comparison_figure(flown: Mapping[str, Mapping[str, FlightErrors]]) -> Chart:
    """Return the position error over time of each vehicle, a panel a flight."""
    looks = [LineStyle(colour) for colour in PALETTE] + [LineStyle(GREY, dash="dash")]
    flights = list(dict.fromkeys(name for errors in flown.values() for name in errors))[
        :MAX_COLUMNS
    ]
    panels = []
    for name in flights:
        lines = []
        for number, (vehicle, errors) in enumerate(flown.items()):
            position = errors[name].position
            error = 1e3 * np.linalg.norm(position.simulated - position.recorded, axis=1)
            shown = rounded(np.maximum(error, MIN_DRAWN), 4)
            time = rounded(position.time, 3)
            lines.append(Line(vehicle, time, shown, looks[min(number, len(looks) - 1)]))
        panels.append(Panel(lines, y_title=f"{name} [mm]", y_scale="log"))
    title = "Position error over time"
    return Chart("comparison", title, panels, x_title="time [s]", height=120 + 160 * len(panels))


SUFFIXES = (".png", ".svg", ".pdf")
"""Of files with a figure."""
WIDTH = 6.3
"""Inches: the text width of a page with usual margins."""
LEGEND_COLUMNS = 5
PIXELS = 96.0
"""An inch of the page on a screen."""
MAX_SCALE_RATIO = 1.001
"""Numbers that differ by less than so many times are one, for a logarithmic axis."""
DASHES = {"solid": "-", "dot": ":", "dash": "--"}
SETTINGS: dict[Any, Any] = {
    "font.size": 8,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "svg.fonttype": "none",
    "svg.hashsalt": "tune",
}


def write_plots(charts: Sequence[Chart], folder: Path) -> tuple[Path, ...]:
    """Write each chart as ``plots/KEY.svg`` of a folder; the same charts give the same bytes."""
    make_folder(inside(folder, PLOTS))
    paths = tuple(plot_file(folder, chart) for chart in charts)
    for chart, path in zip(charts, paths, strict=True):
        write_figure(chart, path)
    return paths


def check_figure(path: Path) -> None:
    """Refuse a file that no figure can be written to, before anything is computed.

    Raises
    ------
    InputError
        Its suffix is none of `SUFFIXES`, or it cannot be written.
    """
    if path.suffix not in SUFFIXES:
        what = f"a figure cannot be written as '{path.suffix}'"
        raise InputError(path, what, f"name one of {', '.join(SUFFIXES)}")
    check_file(path)


def write_figure(chart: Chart, path: Path) -> None:
    """Write a chart into a file, as what its name ends in."""
    import matplotlib as mpl  # noqa: PLC0415 (a second to import)

    mpl.use("Agg", force=False)
    with mpl.rc_context(SETTINGS), whole_file(path) as unfinished:
        unfinished.write_bytes(_figure_of(chart, path.suffix[1:]))


def plot_file(folder: Path, chart: Chart) -> Path:
    """Return where a chart's SVG file lies in a result folder."""
    return inside(folder, f"{PLOTS}/{file_name(chart.key, '.svg')}")


def _figure_of(chart: Chart, kind: str) -> bytes:
    from matplotlib import pyplot as plt  # noqa: PLC0415

    count = len(chart.panels)
    only_lines = all(isinstance(mark, Line) for panel in chart.panels for mark in panel.marks)
    figure, axes = plt.subplots(
        count,
        1,
        sharex=count > 1,
        squeeze=False,
        figsize=(WIDTH, max(chart.height / PIXELS * 0.75, 2.0)),
        layout=None if only_lines else "constrained",
    )
    for panel, place in zip(chart.panels, axes[:, 0], strict=True):
        _draw(panel, place)
    axes[-1, 0].set_xlabel(chart.x_title)
    names, handles = _legend(list(axes[:, 0]))
    named = len(names) > 1
    if named:
        figure.legend(
            handles,
            names,
            loc="upper left" if only_lines else "outside upper left",
            ncols=min(len(names), LEGEND_COLUMNS),
        )
    if only_lines:
        _leave_margins(figure, legend_rows=math.ceil(len(names) / LEGEND_COLUMNS) if named else 0)
    buffer = io.BytesIO()
    dated = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind, {})
    figure.savefig(buffer, format=kind, dpi=200, metadata={"Title": chart.title, **dated})
    plt.close(figure)
    return buffer.getvalue()


def _leave_margins(figure: Figure, *, legend_rows: int) -> None:
    """Leave room for what stands beside lines, whose labels are numbers: nothing is measured.

    To measure it ("constrained" layout) draws every figure twice.
    """
    width, height = figure.get_size_inches()
    figure.subplots_adjust(
        left=0.68 / width,
        right=1.0 - 0.12 / width,
        bottom=0.42 / height,
        top=1.0 - (0.12 + 0.22 * legend_rows) / height,
        hspace=0.14,
    )


def _legend(axes: Sequence[Any]) -> tuple[list[str], list[Any]]:
    entries: dict[str, Any] = {}
    for place in axes:
        for handle, name in zip(*place.get_legend_handles_labels(), strict=True):
            entries.setdefault(name, handle)
    return list(entries), list(entries.values())


def _draw(panel: Panel, place: Axes) -> None:
    left: Any = 0.0
    for mark in panel.marks:
        if isinstance(mark, Line):
            _line(mark, place)
        elif isinstance(mark, Bars):
            left = _bars(mark, place, left)
        else:
            _heat(mark, place)
    place.set_ylabel(panel.y_title)
    if not any(isinstance(mark, HeatMap) for mark in panel.marks):  # whose ticks it would take away
        tabular = any(isinstance(mark, Bars) for mark in panel.marks)
        if panel.y_scale == "log" and not tabular and place.dataLim.y1 > 0:
            place.set_yscale("log")
            _label_decades(place.yaxis)
        if panel.x_scale == "log" and place.dataLim.x1 > 0:
            least, largest = place.dataLim.minposx, place.dataLim.x1
            if largest < MAX_SCALE_RATIO * least:  # but for rounding errors, which leave no axis
                place.set_xlim(0.5 * least, 2.0 * largest)
            place.set_xscale("log")
            _label_decades(place.xaxis)
    if panel.equal:
        place.set_aspect("equal", adjustable="datalim")
    for value, text in panel.levels:
        place.axhline(value, linestyle="--", linewidth=0.8, color="0.4")
        place.annotate(
            text, (1, value), xycoords=("axes fraction", "data"), ha="right", va="bottom"
        )


def _label_decades(axis: Axis) -> None:
    """Label an axis 0.001 rather than 10⁻³, whose setting takes half of a figure's time."""
    from matplotlib.ticker import LogFormatter, StrMethodFormatter  # noqa: PLC0415

    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(LogFormatter())


def _line(line: Line, place: Axes) -> None:
    look = line.look
    place.plot(
        np.array(line.x, dtype=float),
        np.array([np.nan if y is None else y for y in line.y]),
        label=line.name,
        color=look.colour,
        linestyle=DASHES[look.dash] if line.joined else "none",
        linewidth=0.7 * look.width,
        marker="o" if look.marks or not line.joined else "",
        markersize=3,
    )


def _bars(bars: Bars, place: Axes, left: Any) -> Any:
    """Draw bars that begin at some numbers, and return where they end."""
    values = np.array([0.0 if value is None else value for value in bars.values])
    place.barh(list(bars.labels), values, left=left, color=bars.colour, label=bars.name)
    if not place.yaxis_inverted():
        place.invert_yaxis()
    return left + values


def _heat(heat: HeatMap, place: Axes) -> None:
    values = np.array([[np.nan if v is None else v for v in row] for row in heat.values])
    look = {"cmap": "RdBu_r", "vmin": -1.0, "vmax": 1.0} if heat.diverging else {"cmap": "cividis"}
    image = place.imshow(values, aspect="auto", **look)
    place.grid(visible=False)
    place.set_yticks(range(len(heat.rows)), heat.rows)
    if heat.columns and isinstance(heat.columns[0], str):
        place.set_xticks(range(len(heat.columns)), [str(c) for c in heat.columns], rotation=60)
        place.tick_params(axis="x", labelsize=6)
    else:
        shown = range(0, len(heat.columns), max(len(heat.columns) // 8, 1))
        place.set_xticks(list(shown), [f"{float(heat.columns[i]):.0f}" for i in shown])
    for (row, column), value in np.ndenumerate(values):
        if heat.digits is not None:
            text = f"{value:.{heat.digits}f}"
            place.text(column, row, text, ha="center", va="center", fontsize=5)
    bar = place.figure.colorbar(image, ax=place, label=heat.bar)
    if heat.ticks:
        bar.set_ticks(list(heat.ticks), labels=list(heat.ticks.values()))
