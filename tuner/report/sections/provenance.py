"""What it was made of and with: inputs, settings, versions, the command."""

from __future__ import annotations

import hashlib
import json

from tuner.report.contents import Contents
from tuner.report.section import Section

#: Settings that other sections show.
SHOWN = ("command", "origin", "starts")


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
