"""The sections that are sentences and tables alone, without a figure."""

from __future__ import annotations

import hashlib
import json

from tuner.report.contents import Contents
from tuner.report.section import Section
from tuner.uncertainty.sources import CONFLICT
from tuner.vehicle import COEFFICIENTS
from tuner.wording.findings import remedy, sentence
from tuner.wording.phrases import percent
from tuner.wording.proposals import next_log_in_words
from tuner.wording.result import effective_in_words, refits_in_words, rmse_in_words

#: Settings that other sections show.
SHOWN = ("command", "origin", "starts")


def findings(contents: Contents) -> Section | None:
    """Return what was noticed before, during and after the search, as sentences."""
    rows = [
        {
            "level": finding.level,
            "subject": finding.subject,
            "sentence": sentence(finding),
            "remedy": remedy(finding),
        }
        for finding in contents.about.findings
    ]
    title = "What to know before believing a number"
    return Section("findings", title, {"findings": rows}) if rows else None


def refits(contents: Contents) -> Section | None:
    """Return a table of the errors by jackknife and bootstrap, where they were asked for."""
    if contents.run is None:
        return None
    result = contents.run.result
    rows = [
        {"name": name, "found": found}
        for name, found in result.coefficients.items()
        if found.jackknife_error is not None or found.bootstrap_error is not None
    ]
    if not rows:
        return None
    return Section(
        "refits", "Refits to other flights", {"rows": rows, "said": refits_in_words(result)}
    )


def sources(contents: Contents) -> Section | None:
    """Return a table of what the ground, the flights and both give."""
    if contents.run is None or not contents.run.result.sources:
        return None
    rows = [
        {
            "name": name,
            "unit": COEFFICIENTS[name].unit,
            "source": source,
            "conflict": source.deviation is not None and abs(source.deviation) > CONFLICT,
        }
        for name, source in contents.run.result.sources.items()
    ]
    return Section("sources", "Ground and flights", {"rows": rows})


def next_log(contents: Contents) -> Section | None:
    """Return what other signals, or more samples, would narrow."""
    if contents.run is None or not contents.run.result.next_log:
        return None
    sentences = next_log_in_words(contents.run.result.next_log)
    return Section("next_log", "What to log next time", {"sentences": sentences}, [])


def effective(contents: Contents) -> Section | None:
    """Return both answers beside each other, and what each term that is lost is worth."""
    found = None if contents.run is None else contents.run.result.effective
    if contents.run is None or found is None:
        return None
    physical = {name: row.best for name, row in contents.run.result.coefficients.items()}
    rows = [
        {
            "name": name,
            "unit": COEFFICIENTS[name].unit,
            "physical": physical[name],
            "effective": value,
            "change": _change(physical[name], value),
        }
        for name, value in found.coefficients.items()
        if name in physical and value != physical[name]
    ]
    lost = [
        {"group": term.group, "names": term.names, "rmse": rmse_in_words(term.rmse_without)}
        for term in found.lost
    ]
    values = {"sentence": effective_in_words(found), "rows": rows, "lost": lost}
    return Section("effective", "In Gazebo", values)


def _change(before: float, after: float) -> str:
    if before == 0.0:
        return "–"
    share = after / before - 1.0
    return f"{'+' if share > 0 else '−'}{percent(abs(share))}"


def provenance(contents: Contents) -> Section:
    """Return everything that decides the numbers."""
    about = contents.about
    settings = {name: value for name, value in about.settings.items() if name not in SHOWN}
    texts = {name: json.dumps(value, indent=2) for name, value in settings.items()}
    values = {
        "about": about,
        "origin": about.settings.get("origin", {}),
        "settings": texts,
        "hashes": {
            name: _digest(about.settings[name])
            for name in ("vehicle", "controller", "job")
            if name in about.settings
        },
        "seed": contents.run.result.seed if contents.run else None,
    }
    return Section("provenance", "Provenance", values)


def _digest(value: object) -> str:
    """Return the SHA-256 of a setting's content, however its file was laid out."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
