"""Charts as plain data for plotly."""

from __future__ import annotations

from typing import Any

from tuner.report.chart import Bars, Chart, Heat, Line, Panel

GAP = 0.06
"""Share of the height between two panels."""
#: From what is little to what is much, readable in black and white and by the colour blind.
SEQUENTIAL = "Cividis"
#: Blue below, red above, white at zero.
DIVERGING = "RdBu"

Json = dict[str, Any]


def figure_of(chart: Chart) -> Json:
    """Return the traces and layout of a chart, colours of text and grid left to the page."""
    layout: Json = {
        "height": chart.height,
        "margin": {"l": 70, "r": 12, "t": 28, "b": 50},
        "legend": {"orientation": "h", "y": 1.0, "yanchor": "bottom", "x": 0},
        "barmode": "stack",
        "hovermode": "closest",
    }
    traces: list[Json] = []
    shown: set[str] = set()
    count = len(chart.panels)
    for number, panel in enumerate(chart.panels, start=1):
        suffix = "" if number == 1 else str(number)
        panel_traces, axes = _panel(panel, suffix, shown)
        traces += panel_traces
        height = (1.0 - GAP * (count - 1)) / count
        top = 1.0 - (number - 1) * (height + GAP)
        axes[f"yaxis{suffix}"]["domain"] = [max(top - height, 0.0), top]
        axes[f"xaxis{suffix}"]["anchor"] = f"y{suffix}"
        axes[f"yaxis{suffix}"]["anchor"] = f"x{suffix}"
        if number > 1:
            axes[f"xaxis{suffix}"]["matches"] = "x"
        if number < count:
            axes[f"xaxis{suffix}"]["showticklabels"] = False
        else:
            axes[f"xaxis{suffix}"]["title"] = {"text": chart.x_title}
        layout |= axes
    layout["shapes"] = [
        _level(value, "" if n == 1 else str(n))
        for n, panel in enumerate(chart.panels, start=1)
        for value, _ in panel.levels
    ]
    layout["annotations"] = [
        {
            "xref": "x domain",
            "yref": f"y{'' if n == 1 else n}",
            "x": 1,
            "y": value,
            "text": text,
            "showarrow": False,
            "xanchor": "right",
            "yanchor": "bottom",
        }
        for n, panel in enumerate(chart.panels, start=1)
        for value, text in panel.levels
    ]
    layout["showlegend"] = len(shown) > 1
    return {"key": chart.key, "clock": chart.clock, "data": traces, "layout": layout}


def _panel(panel: Panel, suffix: str, shown: set[str]) -> tuple[list[Json], Json]:
    x_axis: Json = {"type": panel.x_scale, "automargin": True}
    y_axis: Json = {"type": panel.y_scale, "title": {"text": panel.y_title}, "automargin": True}
    if panel.equal:
        y_axis |= {"scaleanchor": f"x{suffix}", "constrain": "domain"}
        x_axis |= {"constrain": "domain"}
    traces = []
    for mark in panel.marks:
        if isinstance(mark, Line):
            trace = _line(mark)
        elif isinstance(mark, Bars):
            trace = _bars(mark)
            y_axis |= {"type": "category", "autorange": "reversed"}
        else:
            trace = _heat(mark)
            y_axis |= {"type": "category", "autorange": "reversed"}
            if mark.columns and isinstance(mark.columns[0], str):
                x_axis |= {"type": "category", "tickangle": -50}
        if not isinstance(mark, Heat):
            trace |= {"legendgroup": mark.name, "showlegend": mark.name not in shown}
            shown.add(mark.name)
        traces.append(trace | {"xaxis": f"x{suffix}", "yaxis": f"y{suffix}"})
    return traces, {f"xaxis{suffix}": x_axis, f"yaxis{suffix}": y_axis}


def _line(line: Line) -> Json:
    look = line.look
    mode = ("lines+markers" if look.marks else "lines") if line.joined else "markers"
    trace: Json = {
        "type": "scatter",
        "mode": mode,
        "name": line.name,
        "x": list(line.x),
        "y": list(line.y),
        "line": {"color": look.colour, "width": look.width, "dash": look.dash},
        "marker": {"color": look.colour, "size": 7},
    }
    if line.text:
        trace |= {"text": list(line.text), "hovertemplate": "%{text}<extra></extra>"}
    return trace


def _bars(bars: Bars) -> Json:
    trace: Json = {
        "type": "bar",
        "orientation": "h",
        "name": bars.name,
        "y": list(bars.labels),
        "x": list(bars.values),
        "marker": {"color": bars.colour},
    }
    if bars.text:
        trace |= {
            "hovertext": list(bars.text),
            "hovertemplate": "%{hovertext}<extra></extra>",
        }
    return trace


def _heat(heat: Heat) -> Json:
    trace: Json = {
        "type": "heatmap",
        "x": list(heat.columns),
        "y": list(heat.rows),
        "z": [list(row) for row in heat.values],
        "colorscale": DIVERGING if heat.diverging else SEQUENTIAL,
        "colorbar": {"title": {"text": heat.bar, "side": "right"}, "thickness": 12},
        "xgap": 0 if heat.digits is None else 1,
        "ygap": 1,
    }
    if heat.diverging:
        trace |= {"zmin": -heat.limit, "zmax": heat.limit}
    if heat.ticks:
        trace["colorbar"] |= {"tickvals": list(heat.ticks), "ticktext": list(heat.ticks.values())}
    if heat.text:
        trace |= {
            "text": [list(row) for row in heat.text],
            "hovertemplate": "%{text}<extra></extra>",
        }
    if heat.digits is not None:
        trace["texttemplate"] = f"%{{z:.{heat.digits}f}}"
    return trace


def _level(value: float, suffix: str) -> Json:
    return {
        "type": "line",
        "xref": "x domain",
        "yref": f"y{suffix}",
        "x0": 0,
        "x1": 1,
        "y0": value,
        "y1": value,
        "line": {"dash": "dash", "width": 1},
    }
