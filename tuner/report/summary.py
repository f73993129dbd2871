"""The page's first sentences."""

from __future__ import annotations

from collections import Counter

import numpy as np

from tuner.report.contents import Contents
from tuner.result import RunResult
from tuner.wording.phrases import listed
from tuner.wording.proposals import proposals_in_words
from tuner.wording.verdicts import verdict_in_words


def summary(contents: Contents) -> list[str]:
    """Return what was found, a sentence each."""
    said = []
    if contents.run is not None:
        said.append(of_run(contents.run.result))
    if contents.knowledge is not None:
        known = [one for one in contents.knowledge.coefficients.values() if one.fitted]
        counts = Counter(verdict_in_words(one.verdict) for one in known)
        parts = [f"{count} {'is' if count == 1 else 'are'} {v}" for v, count in counts.items()]
        if len(parts) == 1 and len(known) > 1:
            parts = [f"all {len(known)} are {next(iter(counts))}"]
        verdicts = listed(parts)
        if contents.run is None:
            flights = len(contents.knowledge.flights)
            said.append(
                f"{len(known)} coefficients were examined on {flights} "
                f"flight{'s' if flights != 1 else ''}, nothing fitted: {verdicts}."
            )
        elif verdicts:
            said.append(f"Of the coefficients, {verdicts}.")
    if contents.proposals is not None:
        said += proposals_in_words(contents.proposals)[:2]
    return said


def of_run(result: RunResult) -> str:
    """Return a fit in one sentence."""
    fitted = [flight for flight in result.flights if flight.split == "fit"]
    held = [flight for flight in result.flights if flight.split == "holdout"]
    known = [one for one in result.coefficients.values() if one.fitted]
    unknown = sum(one.identifiable is False for one in known)
    text = (
        f"{len(known)} coefficients were fitted to {len(fitted)} "
        f"flight{'s' if len(fitted) != 1 else ''}"
    )
    text += f", of which the flights do not identify {unknown}" if unknown else ""
    pairs = [(_length(f.rmse_initial), _length(f.rmse_best)) for f in held or fitted]
    numbers = [(before, after) for before, after in pairs if before is not None and after]
    if numbers:
        before, after = (float(value) for value in np.sqrt(np.mean(np.square(numbers), axis=0)))
        where = "held-out" if held else "fitted"
        text += f"; on the {where} flights the position RMSE went from {_metres(before)} to "
        text += _metres(after)
    return text + "."


def _length(rmse: object) -> float | None:
    parts = [getattr(rmse, axis) for axis in ("x", "y", "z")]
    return None if None in parts else float(np.sqrt(sum(part**2 for part in parts)))


def _metres(value: float) -> str:
    return f"{100 * value:.1f} cm" if value >= 0.01 else f"{1000 * value:.2f} mm"
