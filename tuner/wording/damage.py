"""What a broken recording has lost, as a sentence."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from tuner.flights.damage import Cause, Damage


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _dropouts(damage: Damage) -> str:
    lost = f" ({damage.seconds_lost:.2f} s in all)" if damage.seconds_lost else ""
    return f"the vehicle's logger dropped messages {_count(damage.occurrences, 'time')}{lost}"


_HOW: Mapping[Cause, Callable[[Damage], str]] = {
    Cause.NOT_CLOSED: lambda _: "the recording was not closed and has no index",
    Cause.END_MISSING: lambda _: "the end of the file is missing",
    Cause.INDEX_DAMAGED: lambda _: "the index of the file is damaged",
    Cause.CHUNKS_DAMAGED: lambda d: f"{_count(d.occurrences, 'chunk')} of the file cannot be read",
    Cause.MESSAGES_DAMAGED: lambda d: f"messages of {d.subject} are cut or damaged",
    Cause.DATABASE_DAMAGED: lambda _: "pages of the database are damaged",
    Cause.LOG_DAMAGED: lambda _: "parts of the log are damaged",
    Cause.LOGGER_DROPOUTS: _dropouts,
    Cause.ROWS_MALFORMED: lambda _: "lines of the table have too few or too many cells",
    Cause.FILE_UNREADABLE: lambda d: f"{d.subject} cannot be read",
    Cause.METADATA_MISSING: lambda d: (
        f"{d.subject} is missing or damaged, so all data files in the folder are read"
    ),
}


def damage_sentence(damage: Damage) -> str:
    """Return how a recording is broken, what was lost, what was salvaged and when.

    Times count from the start of the mission, or as those of the damage do.
    """
    parts = [_HOW[damage.cause](damage)]
    lost = [] if damage.lost is None else [_count(damage.lost, _noun(damage.cause))]
    lost += [_count(damage.bytes_lost, "byte")] if damage.bytes_lost else []
    if lost:
        parts.append(f"{' in '.join(lost)} lost")
    if damage.salvaged is not None:
        parts.append(f"{_count(damage.salvaged, 'message')} salvaged")
    if damage.start is not None:
        until = "" if damage.end is None else f" to t = {damage.end:.2f} s"
        parts.append(f"from t = {damage.start:.2f} s{until}")
    return "; ".join(parts)


def _noun(cause: Cause) -> str:
    return "row" if cause is Cause.ROWS_MALFORMED else "message"
