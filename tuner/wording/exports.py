"""What became of the exports that a job asks for, as sentences."""

from __future__ import annotations

from pathlib import Path

from tuner.errors import InputError


def export_sentence(kind: str, outcome: Path | InputError) -> str:
    """Return where a format was written, or why it was refused."""
    if isinstance(outcome, Path):
        return f"The {kind} export was written to {outcome}."
    return f"The {kind} export was refused: {outcome}."
