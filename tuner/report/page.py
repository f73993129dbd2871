"""The page: tables and interactive plots, everything inside one file."""

from __future__ import annotations

import base64
import gzip
import json
from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from numpy.typing import NDArray

from tuner.config.yaml_file import write_text
from tuner.report.traces import read_traces
from tuner.result import RunResult, read_run

REPORT_FILE = "report.html"
AXES = ("x", "y", "z", "roll", "pitch", "yaw")
#: Told apart with every common kind of colour blindness: recorded, initial, fitted.
COLOURS = ("#7a7a7a", "#d55e00", "#0072b2")


def render(folder: str | Path) -> Path:
    """Write ``report.html`` of a result folder, and return its path.

    Raises
    ------
    InputError
        It is no result folder.
    """
    run = read_run(folder)
    environment = Environment(
        loader=PackageLoader("tuner.report"), autoescape=True, undefined=StrictUndefined
    )
    environment.filters |= {"figures": _figures, "axis_of": getattr}
    text = environment.get_template("report.html.jinja").render(
        result=run.result,
        vehicle=run.vehicle,
        axes=AXES,
        summary=summary(run.result),
        findings=run.result.settings.get("findings", []),
        plots=Markup(_embedded(json.dumps(plots(run.folder)))),
        plotly=Markup(_plotly()),
    )
    path = run.folder / REPORT_FILE
    write_text(path, text)
    return path


def summary(result: RunResult) -> str:
    """Return the run in one sentence."""
    fitted = [flight for flight in result.flights if flight.split == "fit"]
    held = [flight for flight in result.flights if flight.split == "holdout"]
    known = [one for one in result.coefficients.values() if one.fitted]
    unknown = sum(one.identifiable is False for one in known)
    text = (
        f"{len(known)} coefficients were fitted to {len(fitted)} "
        f"flight{'s' if len(fitted) != 1 else ''}"
    )
    text += f", of which {unknown} cannot be told from these flights" if unknown else ""
    pairs = [(_length(f.rmse_initial), _length(f.rmse_best)) for f in held or fitted]
    numbers = [(before, after) for before, after in pairs if before is not None and after]
    if numbers:
        before, after = (float(value) for value in np.sqrt(np.mean(np.square(numbers), axis=0)))
        where = "held-out" if held else "fitted"
        text += f"; on the {where} flights the position RMSE went from {_metres(before)} to "
        text += _metres(after)
    return text + "."


def plots(folder: Path) -> list[dict[str, object]]:
    """Return one plotly figure a flight and quantity, as plain data."""
    found: list[dict[str, object]] = []
    for flight, arrays in read_traces(folder).items():
        for quantity, names, unit in (
            ("position", ("x", "y", "z"), "m"),
            ("attitude", ("roll", "pitch", "yaw"), "deg"),
        ):
            found.append(_figure(flight, quantity, names, unit, arrays))
    return found


def _figure(
    flight: str,
    quantity: str,
    names: tuple[str, str, str],
    unit: str,
    arrays: dict[str, NDArray[np.float64]],
) -> dict[str, object]:
    time = _rounded(arrays[f"{quantity}_time"], 3)
    curves = []
    for which, suffix, colour in zip(
        ("recorded", "initial", "fitted"), ("", "_initial", "_best"), COLOURS, strict=True
    ):
        values = arrays[f"{quantity}{suffix}"]
        for row, name in enumerate(names):
            curves.append(
                {
                    "x": time,
                    "y": _rounded(values[:, row], 4),
                    "name": which,
                    "legendgroup": which,
                    "showlegend": row == 0,
                    "xaxis": "x",
                    "yaxis": "y" if row == 0 else f"y{row + 1}",
                    "line": {
                        "color": colour,
                        "width": 3 if which == "recorded" else 1.5,
                        "dash": "dot" if which == "initial" else "solid",
                    },
                    "hovertemplate": f"%{{x:.2f}} s, {name} %{{y:.3f}} {unit}",
                    "mode": "lines",
                }
            )
    layout: dict[str, object] = {
        "height": 420,
        "margin": {"l": 60, "r": 10, "t": 10, "b": 45},
        "legend": {"orientation": "h", "y": 1.08},
        "xaxis": {"title": {"text": "time since mission start [s]"}, "anchor": "y3"},
    }
    for row, name in enumerate(names):
        top = 1.0 - row * 0.345
        axis = "yaxis" if row == 0 else f"yaxis{row + 1}"
        layout[axis] = {"title": {"text": f"{name} [{unit}]"}, "domain": [top - 0.31, top]}
    return {"flight": flight, "quantity": quantity, "data": curves, "layout": layout}


def _rounded(values: NDArray[np.float64], digits: int) -> list[float]:
    return [round(float(value), digits) for value in values]


def _length(rmse: object) -> float | None:
    parts = [getattr(rmse, axis) for axis in ("x", "y", "z")]
    return None if None in parts else float(np.sqrt(sum(part**2 for part in parts)))


def _figures(value: float | None) -> str:
    """Write a number to five significant figures."""
    return "–" if value is None else f"{value:.5g}"


def _metres(value: float) -> str:
    return f"{100 * value:.1f} cm" if value >= 0.01 else f"{1000 * value:.2f} mm"


def _embedded(text: str) -> str:
    """Keep data from ending the script element that it stands in."""
    return text.replace("</", "<\\/")


def _plotly() -> str:
    """Return the plotting library, compressed: plain it would fill the page's five megabytes."""
    from plotly.offline import get_plotlyjs  # noqa: PLC0415 (a second to import)

    return base64.b64encode(gzip.compress(get_plotlyjs().encode(), mtime=0)).decode()
