"""A section of the page: a template with its values, and charts below it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from tuner.report.chart import Chart


@dataclass(frozen=True)
class Section:
    """One part of the page.

    Attributes
    ----------
    key
        Its anchor, and the name of its template.
    title
        Heading.
    values
        What the template shows.
    charts
        Drawn where the template asks for them by ``charts``, in this order.
    """

    key: str
    title: str
    values: Mapping[str, object] = field(default_factory=dict)
    charts: Sequence[Chart] = ()
