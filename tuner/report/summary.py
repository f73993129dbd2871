"""The page's first sentences."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from tuner.core.phrases import listed
from tuner.design.texts import proposals_in_words
from tuner.ground.texts import bench_in_words
from tuner.report.contents import Contents
from tuner.result import RunResult
from tuner.uncertainty.verdict import Verdict
from tuner.uncertainty.verdict_texts import verdict_in_words


def summary(contents: Contents) -> list[str]:
    """Return the outcome in sentences."""
    sentences = []
    if contents.run is not None:
        result, bench = contents.run.result, contents.bench
        sentences += [_of_fit(result) if bench is None else bench_in_words(bench), *_judged(result)]
    elif contents.knowledge is not None:
        known = contents.knowledge.coefficients.values()
        verdicts = [coefficient.verdict for coefficient in known if coefficient.fitted]
        flights = len(contents.knowledge.flights)
        sentences.append(
            f"{len(verdicts)} coefficient{'s were' if len(verdicts) != 1 else ' was'} examined on "
            f"{flights} flight{'s' if flights != 1 else ''}, nothing fitted: {_counted(verdicts)}."
        )
    if contents.proposals is not None:
        sentences += proposals_in_words(contents.proposals)[:2]
    return sentences


def outcome(result: RunResult) -> list[str]:
    """Return what a fit came to in sentences: how it fits, and what is known by it."""
    return [_of_fit(result), *_judged(result)]


def _judged(result: RunResult) -> list[str]:
    verdicts = [found.verdict for found in result.coefficients.values() if found.fitted]
    return [f"Of the coefficients, {_counted(verdicts)}."] if verdicts else []


def _counted(verdicts: Sequence[Verdict]) -> str:
    """Return how many coefficients have each verdict, as a clause."""
    counts = Counter(verdict_in_words(verdict) for verdict in verdicts)
    if len(counts) == 1 and len(verdicts) > 1:
        return f"all {len(verdicts)} are {_of_many(next(iter(counts)))}"
    return listed(
        [f"1 is {one}" if n == 1 else f"{n} are {_of_many(one)}" for one, n in counts.items()]
    )


def _of_many(words: str) -> str:
    """Return a verdict as it is said of several coefficients."""
    return words.replace("at its initial value", "at their initial values")


def _of_fit(result: RunResult) -> str:
    """Return a fit in one sentence."""
    fitted = [flight for flight in result.flights if flight.split == "fit"]
    held_out = [flight for flight in result.flights if flight.split == "holdout"]
    free = [coefficient for coefficient in result.coefficients.values() if coefficient.fitted]
    unknown = sum(coefficient.identifiable is False for coefficient in free)
    text = (
        f"{len(free)} coefficient{'s were' if len(free) != 1 else ' was'} fitted to {len(fitted)} "
        f"flight{'s' if len(fitted) != 1 else ''}"
    )
    text += f", of which the flights do not identify {unknown}" if unknown else ""
    pairs = [(_length(f.rmse_initial), _length(f.rmse_best)) for f in held_out or fitted]
    numbers = [(before, after) for before, after in pairs if before is not None and after]
    if numbers:
        before, after = (float(value) for value in np.sqrt(np.mean(np.square(numbers), axis=0)))
        where = "held-out" if held_out else "fitted"
        text += f"; on the {where} flights the position RMSE went from {_metres(before)} to "
        text += _metres(after)
    return text + "."


def _length(rmse: object) -> float | None:
    parts = [getattr(rmse, axis) for axis in ("x", "y", "z")]
    return None if None in parts else float(np.sqrt(sum(part**2 for part in parts)))


def _metres(value: float) -> str:
    return f"{100 * value:.1f} cm" if value >= 0.01 else f"{1000 * value:.2f} mm"
