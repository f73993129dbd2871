"""The page: the outcome, sections and interactive figures, everything inside one file."""

from __future__ import annotations

import base64
import gzip
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from tuner.core.disk import write_text
from tuner.core.errors import InputError
from tuner.design.proposals import proposals_in_words
from tuner.report.contents import Contents, read_contents
from tuner.report.outcome import (
    examination_in_words,
    flights_table,
    next_step,
    outcome,
    warnings_of,
)
from tuner.report.paper import write_plots
from tuner.report.section import PageSection, charts_json
from tuner.report.sections.coefficients import bench, coefficients, effective, refits, sources
from tuner.report.sections.flights import flights, forces
from tuner.report.sections.search import provenance, remarks, search, selection
from tuner.report.sections.sensitivity import (
    effects,
    global_sensitivity,
    information,
    next_flight,
    next_log,
    profiles,
    residuals,
)

REPORT_FILE = "report.html"
LIBRARIES = ("d3.min.js", "plot.umd.min.js")
"""Observable Plot and what it draws with."""


Maker = Callable[[Contents], PageSection | None]


def _of(part: Callable[[Contents], Any], section: Callable[[Any], PageSection | None]) -> Maker:
    """Return the section on one part of a folder; None where it is lacking or empty."""

    def made(contents: Contents) -> PageSection | None:
        found = part(contents)
        return section(found) if found else None

    return made


#: In the order in which a reader needs them.
SECTIONS: tuple[Maker, ...] = (
    coefficients,
    flights,
    _of(lambda contents: contents.result and contents.result.selection, selection),
    _of(lambda contents: contents.result, effective),
    _of(lambda contents: contents.bench, bench),
    _of(lambda contents: contents.result and contents.result.sources, sources),
    _of(lambda contents: contents.result, refits),
    _of(lambda contents: contents.proposals, next_flight),
    _of(lambda contents: contents.result and contents.result.next_log, next_log),
    _of(lambda contents: contents.profiles and contents.profiles.profiles, profiles),
    _of(lambda contents: contents.global_sensitivity, global_sensitivity),
    remarks,
    forces,
    _of(lambda contents: contents.knowledge, effects),
    _of(lambda contents: contents.knowledge, information),
    _of(lambda contents: contents.knowledge and contents.knowledge.residuals, residuals),
    search,
    provenance,
)


def sections_of(contents: Contents) -> tuple[PageSection, ...]:
    """Return the sections that apply."""
    sections = (section(contents) for section in SECTIONS)
    return tuple(
        replace(section, charts=[chart for chart in section.charts if chart.is_worth_drawing])
        for section in sections
        if section is not None
    )


def render(folder: str | Path, *, plots: bool = False) -> Path:
    """Write ``report.html`` of a result folder, and return its path.

    Parameters
    ----------
    folder
        The result folder of a run, or of an examination alone.
    plots
        Also write its figures into ``plots/``, as SVG.

    Raises
    ------
    InputError
        It is no result folder, or its files do not go together.
    """
    contents = read_contents(folder)
    path = contents.folder / REPORT_FILE
    try:
        sections = sections_of(contents)
        page = _page(contents, sections)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        what = f"has files that do not go together ({type(error).__name__}: {error})"
        remedy = "was one edited? run tune again; report this where none was"
        raise InputError(contents.folder, what, remedy) from error
    if plots:
        write_plots([chart for section in sections for chart in section.charts], contents.folder)
    write_text(path, page)
    return path


def _page(contents: Contents, sections: Sequence[PageSection]) -> str:
    run = contents.run
    found = None if run is None else outcome(run.result, contents.bench, contents.exports)
    return page_of(
        contents.about.vehicle,
        sections,
        outcome=found,
        checks=flights_table(found.checks if found else ()),
        next=next_step(run.result, found, contents.folder, contents.exports)
        if run and found
        else None,
        sentences=_examination_sentences(contents),
        warnings=warnings_of(contents.about.findings),
        exports=contents.exports,
    )


def page_of(title: str, sections: Sequence[PageSection], **first_screen: Any) -> str:
    """Return a page of sections that works without a network.

    Parameters
    ----------
    first_screen
        What stands above them, by the names of ``page.html.jinja``.
    """
    environment = templates("tuner.report")
    script = _source(environment, "figures.js") + _source(environment, "page.js")
    library, compressed = _library()
    charts = [chart for section in sections for chart in section.charts]
    return environment.get_template("page.html.jinja").render(
        title=title,
        sections=sections,
        charts=charts,
        policy=_policy(script, library),
        style=Markup(_source(environment, "page.css")),
        script=Markup(script),
        figures=Markup(_compressed(charts_json(charts))),
        library=Markup(compressed),
        **{"outcome": None, "sentences": (), "warnings": (), **first_screen},
    )


@cache
def templates(*packages: str) -> Environment:
    """Return what renders the templates of packages, each compiled once; all in them is escaped."""
    return Environment(
        loader=ChoiceLoader([PackageLoader(package) for package in packages]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


@cache
def _library() -> tuple[str, str]:
    """Return the plotting library, and it compressed."""
    folder = files("tuner.report") / "assets"
    text = "\n".join((folder / name).read_text("utf-8") for name in LIBRARIES)
    return text, _compressed(text)


def _examination_sentences(contents: Contents) -> list[str]:
    """Return sentences on an examination without a fit."""
    first = [] if contents.knowledge is None else [examination_in_words(contents.knowledge)]
    return first + (proposals_in_words(contents.proposals)[:2] if contents.proposals else [])


def _policy(*scripts: str) -> str:
    """Return the content-security policy of the page.

    It runs its own two scripts, known by their hashes, evaluates no text and opens no connection.
    The plotting library sets style attributes; a figure is saved by way of a blob.
    """
    hashes = (base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in scripts)
    allowed = " ".join(f"'sha256-{digest}'" for digest in hashes)
    return (
        f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; "
        "img-src data: blob:; base-uri 'none'; form-action 'none'"
    )


def _source(environment: Environment, name: str) -> str:
    assert environment.loader is not None
    return environment.loader.get_source(environment, name)[0]


def _compressed(text: str) -> str:
    """Return compressed text in Base64, which cannot end its element."""
    level = 6  # 9 takes four times as long for a fortieth less
    return base64.b64encode(gzip.compress(text.encode(), level, mtime=0)).decode()
