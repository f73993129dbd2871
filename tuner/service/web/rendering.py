"""Templates, and how numbers, times and states are written in them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import cache

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from starlette.responses import HTMLResponse

from tuner.recordings.notes import Damage, Note, damage_sentence, note_in_words
from tuner.report.section import figures
from tuner.service.recordings import flight_name
from tuner.service.safety import VISITOR
from tuner.service.shapes import iso
from tuner.service.tables import State
from tuner.service.words import on_the_web

#: State -> what is said of it, and the class of its badge, as the report's verdicts have.
STATES: Mapping[str, tuple[str, str]] = {
    State.QUEUED: ("waiting", "kept"),
    State.RUNNING: ("running", "weak"),
    State.DONE: ("done", "well"),
    State.FAILED: ("failed", "not"),
    State.CANCELLED: ("cancelled", "kept"),
}


@cache
def environment() -> Environment:
    """Return the templates; whatever stands in them is escaped."""
    made = Environment(
        loader=ChoiceLoader([PackageLoader("tuner.service.web"), PackageLoader("tuner.report")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    filters: dict[str, Callable[..., object]] = {
        "figures": figures,
        "short": lambda value: "–" if value is None else f"{value:.2g}",
        "percent": lambda value: "–" if value is None else f"{100 * value:+.2f} %",
        "mm": lambda value: "" if value is None else f"{1000 * value:.2f} mm",
        "megabytes": lambda size: f"{size / 1e6:.1f} MB",
        "ago": _ago,
        "moment": lambda value: "" if value is None else iso(value),
        "lasting": _lasting,
        "flight": flight_name,
        "web": on_the_web,
        "note": lambda raw: note_in_words(Note.read(raw)),
        "damage": lambda raw: damage_sentence(Damage.read(raw)),
    }
    made.filters |= filters
    made.globals |= {"states": STATES, "visitor": VISITOR.get}
    return made


def render(template: str, status: int = 200, /, **values: object) -> HTMLResponse:
    """Return a page."""
    text = environment().get_template(template).render(**values)
    return HTMLResponse(text, status_code=status)


def _ago(seconds: float | None) -> str:
    """Return how long ago a time was, in words."""
    if seconds is None:
        return ""
    passed = max(0.0, time.time() - seconds)
    for size, word in ((86400.0, "day"), (3600.0, "hour"), (60.0, "minute")):
        if passed >= size:
            count = int(passed / size)
            return f"{count} {word}{'' if count == 1 else 's'} ago"
    return "just now"


def _lasting(seconds: float | None) -> str:
    """Return a duration in words."""
    if seconds is None:
        return ""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
