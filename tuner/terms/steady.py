"""Whether what surrounds each flight is steady, or the mean that gusts have over it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc  # scipy.stats takes a quarter of a second to import

from tuner.objective.information import BLOCK
from tuner.terms.linear import SECTIONS, Columns, Linear
from tuner.uncertainty.stretches import STRETCH


def chance_of_gusts(
    linear: Linear, model: Columns, group: Columns, begin: NDArray[np.float64]
) -> float:
    """Return the probability of such values of flights if they are means of what varies in them.

    Gusts have a mean over a flight, and a flight's own columns take it out of the residuals, which
    then no longer show how far such means scatter: wind is found that nobody would meet again. How
    far they do is seen inside flights, where each section gets columns of its own. What columns for
    each flight are worth is compared with what those of its sections are worth beside them, each
    for as many as they are: an analysis of variance, nested (Scheffé, "The analysis of variance",
    1959, ch. 5), whose ratio has Snedecor's F distribution if sections are independent.

    Parameters
    ----------
    linear
        The loss about the point.
    model
        Columns of the coefficients in the model, without the group's.
    group
        Columns for each flight.
    begin
        (P,) change that leads the group to its neutral values.
    """
    sections = _sections(linear.flight)
    cut = _with_columns_for(linear, np.flatnonzero(np.isin(linear.columns[0], group)), sections)
    of_sections = np.arange(len(linear.scaled), len(cut.scaled))
    freedom = len(of_sections) - len(group)
    if freedom < 1:
        return 1.0
    at, everything = np.pad(begin, (0, len(of_sections))), np.ones(len(sections), bool)
    alone, with_flights, with_sections = (
        float(cut.change_of_loss(cut.step(free, inside=everything, from_=at)).sum())
        for free in (model, np.append(model, group), np.append(model, of_sections))
    )
    between = (alone - with_flights) / len(group)
    within = (with_flights - with_sections) / freedom
    return float(fdtrc(len(group), freedom, max(between / max(within, 1e-300), 0.0)))


def _sections(flight: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the section of each stretch (S,): a third of its flight, eight seconds of a long one.

    They are numbered through all flights.
    """
    numbers, count = np.empty(len(flight), np.intp), 0
    for own in np.unique(flight):
        stretches = np.flatnonzero(flight == own)
        many = max(SECTIONS, round(len(stretches) * BLOCK / STRETCH))
        for part in np.array_split(stretches, min(many, len(stretches))):
            numbers[part] = count
            count += 1
    return numbers


def _with_columns_for(linear: Linear, own: NDArray[np.intp], sections: NDArray[np.intp]) -> Linear:
    """Return the same loss where sections have columns of their own, behind all others.

    Each section counts as a flight then. ``own`` says which of the columns that a stretch sees
    they double.
    """
    seen, size, count = linear.columns, len(linear.scaled), sections.max() + 1
    local = np.append(np.arange(seen.shape[1]), own)
    columns = size + sections[:, None] * len(own) + np.arange(len(own))
    more = count * len(own)
    prior = np.zeros((size + more, size + more))
    prior[:size, :size] = linear.prior
    prior[range(size, size + more), range(size, size + more)] = np.tile(
        np.diag(linear.prior)[seen[0, own]], count
    )
    return replace(
        linear,
        scaled=np.pad(linear.scaled, (0, more)),
        hessian=linear.hessian[:, local][:, :, local],
        score=linear.score[:, local],
        prior=prior,
        pull=np.pad(linear.pull, (0, more)),
        prior_sd=np.append(linear.prior_sd, np.tile(linear.prior_sd[seen[0, own]], count)),
        flight=sections,
        seen=np.hstack([seen, columns]),
    )
