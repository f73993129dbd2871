"""The page: sections and interactive figures, everything inside one file."""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Callable, Collection, Sequence
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from tuner.disk import write_text
from tuner.report.chart import Chart
from tuner.report.contents import Contents, read_contents
from tuner.report.interactive import figure_of
from tuner.report.paper import write_plots
from tuner.report.sections import sections_of
from tuner.report.summary import summary

REPORT_FILE = "report.html"


def render(
    folder: str | Path, *, plots: bool = True, drawn: Callable[[], Collection[str]] = frozenset
) -> Path:
    """Write ``report.html`` of a result folder, and return its path.

    Parameters
    ----------
    folder
        Of a run, or of an examination without one.
    plots
        Whether to write the figures as ``plots/*.svg`` too.
    drawn
        Tells in the end which of these are there already.

    Raises
    ------
    InputError
        It is no result folder.
    """
    contents = read_contents(folder)
    sections = sections_of(contents)
    charts = [chart for section in sections for chart in section.charts]
    path = contents.folder / REPORT_FILE
    write_text(path, _page(contents, sections, charts))
    if plots:
        there = drawn()
        write_plots([chart for chart in charts if chart.key not in there], contents.folder)
    return path


def _page(contents: Contents, sections: Sequence[object], charts: Sequence[Chart]) -> str:
    loader = PackageLoader("tuner.report")
    environment = Environment(
        loader=loader,
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"figures": _figures, "rmse": _rmse}
    figures = json.dumps([figure_of(chart) for chart in charts], allow_nan=False)
    return environment.get_template("page.html.jinja").render(
        about=contents.about,
        summary=summary(contents),
        sections=sections,
        style=Markup(_source(environment, "page.css")),
        script=Markup(_source(environment, "page.js")),
        figures=Markup(_packed(figures)),
        plotly=Markup(_packed(_plotly())),
    )


def _source(environment: Environment, name: str) -> str:
    assert environment.loader is not None
    return environment.loader.get_source(environment, name)[0]


def _figures(value: float | None) -> str:
    """Write a number to five significant figures."""
    return "–" if value is None else f"{value:.5g}"


def _rmse(value: float | None) -> str:
    return "crash" if value is None else f"{value:.4f}" if value < 1 else f"{value:.3g}"


def _packed(text: str) -> str:
    """Compress text, and write it so that it cannot end the element that it stands in."""
    return base64.b64encode(gzip.compress(text.encode(), mtime=0)).decode()


def _plotly() -> str:
    """Return the plotting library: plain it would fill the page's five megabytes."""
    from plotly.offline import get_plotlyjs  # noqa: PLC0415 (a second to import)

    return str(get_plotlyjs())
