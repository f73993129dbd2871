"""The page's sections, in the order in which a reader needs them.

Each takes what the result folder holds and returns a `Section`, or None if there is nothing to
show.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from tuner.report.contents import Contents
from tuner.report.section import Section
from tuner.report.sections.bench import bench
from tuner.report.sections.coefficients import coefficients
from tuner.report.sections.flights import flights, forces
from tuner.report.sections.search import search, selection
from tuner.report.sections.sensitivity import (
    effects,
    global_sensitivity,
    information,
    next_flight,
    profiles,
    residuals,
)
from tuner.report.sections.tables import effective, next_log, provenance, refits, remarks, sources

SECTIONS: tuple[Callable[[Contents], Section | None], ...] = (
    coefficients,
    flights,
    selection,
    effective,
    bench,
    sources,
    refits,
    next_flight,
    next_log,
    profiles,
    global_sensitivity,
    remarks,
    forces,
    effects,
    information,
    residuals,
    search,
    provenance,
)


def sections_of(contents: Contents) -> tuple[Section, ...]:
    """Return the sections that apply."""
    sections = (section(contents) for section in SECTIONS)
    return tuple(
        replace(section, charts=[chart for chart in section.charts if chart.is_worth_drawing])
        for section in sections
        if section is not None
    )
