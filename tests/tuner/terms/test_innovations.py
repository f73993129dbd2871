"""Innovations call for terms that are there, let go of those that are not, and doubt the rest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from tests.tuner.uncertainty import making
from tuner.config import JobFile
from tuner.core.numerics import Z95
from tuner.objective.information import FisherInformation
from tuner.objective.space import Space, extended, space_of
from tuner.search.problem import Job
from tuner.search.progress import Fit
from tuner.terms import refit_with_disturbances
from tuner.terms.candidates import SelectionResult, neutral_values
from tuner.terms.linearisation import linearised_from
from tuner.terms.refit_with_disturbances import LinearisedInnovations
from tuner.vehicle import COEFFICIENTS, term_groups
from tuner.vehicle.selection_table import Groups, SelectionCode, SelectionRow

NOBODY = cast(Any, None)
MODEL = ("inertia_xx", "estimate_latency")
USUAL = {
    "fuselage_drag": COEFFICIENTS["fuselage_drag"].prior_sd,
    "rotor_drag_ratio_y": COEFFICIENTS["rotor_drag_ratio_y"].prior_sd,
}
MARKERS_UNSEEN = SimpleNamespace(controller=SimpleNamespace(sees_markers=0.0))
STEPS, STRETCHES, FLIGHTS = 50, 40, 4
TOLD = 10.0
"""By how many of a row's noise a usual coefficient moves a row."""


def wide_space(names: Sequence[str]) -> Space:
    """Return the space of a model's coefficients, and of those of terms at neutral values."""
    space = space_of(making.vehicle_file(), making.controller_file(), JobFile(free=MODEL))
    return extended(space, tuple(names), JobFile(), neutral_values(names))


def information(
    space: Space, truth: Mapping[str, float], *, alike: Mapping[str, str], seed: int = 3
) -> FisherInformation:
    """Return what the rows of four flights say; ``truth`` in usual sizes from the point.

    Each coefficient has a direction of its own, but for those that are alike; latencies none.
    """
    rng, count = np.random.default_rng(seed), len(space)
    unit = {name: rng.standard_normal((FLIGHTS, STRETCHES, STEPS)) for name in space.names}
    for name, other in alike.items():
        unit[name] = 0.9 * unit[other] + np.sqrt(1.0 - 0.9**2) * unit[name]
    seen = np.array([name != "estimate_latency" for name in space.names])
    rows = np.stack([unit[name] for name in space.names], axis=-1) * seen
    rows = rows * (0.1 * TOLD / space.prior_sd)
    moved = np.array([truth.get(name, 0.0) for name in space.names]) * space.prior_sd
    noise = rng.standard_normal(rows.shape[:3])
    errors = noise - rows @ moved
    return FisherInformation(
        channels=("position",),
        flight=np.arange(FLIGHTS),
        blocks=np.einsum("fbnp,fbnq->fbpq", rows, rows)[None],
        score=np.einsum("fbnp,fbn->fbp", rows, errors)[None],
        spread=np.ones((1, FLIGHTS)),
        nuisance_prior=np.zeros((count, count)),
        prior=np.diag(space.prior_sd**-2.0),
        crashed=np.zeros(FLIGHTS, bool),
        begins=np.zeros(FLIGHTS),
        scale=np.ones((1, FLIGHTS)),
    )


def row(group: str, reason: SelectionCode, *, kept: bool = False) -> SelectionRow:
    return SelectionRow(group=group, names=term_groups()[group], kept=kept, reason=reason)


def seen(
    rows: Sequence[SelectionRow],
    truth: Mapping[str, float],
    alike: Mapping[str, str] | None = None,
    *,
    selection_shifts: Mapping[str, float] | None = None,
) -> LinearisedInnovations:
    """Return innovations of a fit of a model and the rows that are kept."""
    kept = [name for r in rows if r.kept for name in r.names]
    space = wide_space([*kept, *(name for r in rows if not r.kept for name in r.names)])
    vector = space.initial
    scaled = np.asarray(space.scaled(vector))
    said = information(space, truth, alike=alike or {})
    loss = 0.5 * FLIGHTS * STRETCHES * STEPS
    fitted = cast(
        Fit,
        SimpleNamespace(
            objective=SimpleNamespace(space=wide_space(kept), model=MARKERS_UNSEEN),
            held={},
            findings=(),
        ),
    )
    base = (NOBODY, NOBODY)
    selected = SelectionResult(cast(Job, NOBODY), fitted, tuple(rows), selection_shifts or {}, base)
    linear = linearised_from(said, scaled, scaled, loss, names=space.names)
    return LinearisedInnovations(selected, fitted, space, vector, linear)


def fitted_at(
    scaled: Mapping[str, float],
    kept: Sequence[SelectionRow],
    left_out: Sequence[SelectionRow],
    alike: Mapping[str, str] | None = None,
) -> LinearisedInnovations:
    """Return innovations of a fit that ends with some coefficients off their neutral values."""
    rows = [*(r.model_copy(update={"kept": True}) for r in kept), *left_out]
    innovation = seen(rows, {}, alike)
    moved = innovation.linear.scaled.copy()
    for name, size in scaled.items():
        moved[list(innovation.space.names).index(name)] = size
    return replace(innovation, linear=replace(innovation.linear, scaled=moved))


@pytest.fixture
def chosen(monkeypatch: pytest.MonkeyPatch):
    """Return what says which groups are chosen, and their numbers; None where nothing changes."""
    found: dict[str, Any] = {}

    def with_groups(
        _: object, groups: Groups, fitted: object, vector: Mapping[str, float], **__: object
    ) -> tuple[object, object]:
        found.update(groups=groups, vector=vector)
        return NOBODY, fitted

    monkeypatch.setattr(refit_with_disturbances, "with_groups", with_groups)

    def choose(
        innovation: LinearisedInnovations,
        had: Sequence[str] = (),
        *,
        first: bool = False,
        lags: bool = False,
    ) -> tuple[SelectionResult, dict[str, Any]] | None:
        selected = innovation.with_lag_terms() if lags else innovation.selection(had, first=first)
        return None if selected is None else (selected, found)

    return choose


DRAG = row("fuselage_drag", SelectionCode.NOT_SIGNIFICANT)
RATIO = row("rotor_drag_ratio", SelectionCode.IMMATERIAL)
FLAPPING = row("flapping_moment", SelectionCode.NOT_PREDICTED)


def test_a_term_that_least_squares_missed_is_called_for(chosen) -> None:
    rows = [DRAG, RATIO, FLAPPING]
    innovation = seen(rows, {"fuselage_drag": 0.5})
    selected, found = chosen(innovation)
    assert set(found["groups"]) == {"fuselage_drag"}
    assert [r.kept for r in selected.rows] == [True, False, False]
    assert selected.rows[0].reason is SelectionCode.PREDICTS_SAMPLES
    assert selected.left_out == (RATIO.names, FLAPPING.names)
    numbers = innovation.space.numbers(
        np.array([found["vector"][name] for name in innovation.space.names])
    )
    assert float(numbers["fuselage_drag"]) == pytest.approx(0.5 * USUAL["fuselage_drag"], rel=0.05)


def test_chance_adds_no_term(chosen) -> None:
    assert chosen(seen([DRAG, RATIO, FLAPPING], {})) is None


def test_a_term_as_good_as_absent_is_not_worth_a_coefficient(chosen) -> None:
    """However surely it is told: two simulators of a vehicle differ by as much."""
    assert chosen(seen([DRAG], {"fuselage_drag": 0.05})) is None


def test_a_small_term_that_another_would_make_up_for_is_worth_one(chosen) -> None:
    """Sizes that are usual of large vehicles are not of small ones."""
    alike = {"fuselage_drag": "inertia_xx"}
    _, found = chosen(seen([DRAG, RATIO], {"fuselage_drag": 0.05}, alike))
    assert set(found["groups"]) == {"fuselage_drag"}
    assert chosen(seen([DRAG, RATIO], {"fuselage_drag": 0.05})) is None


def test_a_term_that_replaced_another_is_removed_as_that_one_is_added(chosen) -> None:
    there = row("angular_drag", SelectionCode.SIGNIFICANT, kept=True)
    innovation = seen(
        [there, RATIO],
        {"rotor_drag_ratio_y": 0.5, "angular_drag_x": 0.0},
        {"angular_drag_x": "rotor_drag_ratio_y"},
    )
    selected, found = chosen(innovation)
    assert set(found["groups"]) == {"rotor_drag_ratio"}
    assert [(r.group, r.reason) for r in selected.rows] == [
        ("rotor_drag_ratio", SelectionCode.PREDICTS_SAMPLES),
        ("angular_drag", SelectionCode.NOT_SIGNIFICANT),
    ]


def test_a_lumped_term_of_least_squares_is_removed_first_and_returns_where_no_other_is_kept(
    chosen,
) -> None:
    """Gusts pass for it, and from there what it stands in for looks as if it were not there."""
    truth, had = {"angular_drag_x": 0.5}, ["angular_drag"]
    there = row("angular_drag", SelectionCode.SIGNIFICANT, kept=True)
    assert chosen(seen([there, RATIO], truth), had) is None  # it stays where it was judged before
    selected, found = chosen(seen([there, RATIO], truth), had, first=True)
    assert not found["groups"]
    assert not any(r.kept for r in selected.rows)
    gone = row("angular_drag", SelectionCode.NOT_SIGNIFICANT)
    _, found = chosen(seen([gone, RATIO], truth), had)
    assert set(found["groups"]) == {"angular_drag"}
    assert chosen(seen([gone, RATIO], truth), ()) is None


def test_others_are_judged_without_the_lumped_term(chosen) -> None:
    """A fit with it leaves nothing for another to do that does the same."""
    there = row("angular_drag", SelectionCode.SIGNIFICANT, kept=True)
    innovation = seen(
        [there, RATIO],
        {},
        {"angular_drag_x": "rotor_drag_ratio_y"},
    )
    moved = innovation.linear.scaled.copy()
    moved[list(innovation.space.names).index("angular_drag_x")] = (
        2.0 * COEFFICIENTS["angular_drag_x"].prior_sd
    )
    stood_in = replace(innovation, linear=replace(innovation.linear, scaled=moved))
    _, found = chosen(stood_in, first=True)
    assert set(found["groups"]) == {"rotor_drag_ratio"}


@pytest.mark.parametrize(
    "rows",
    [
        [row("linear_drag", SelectionCode.NOT_SIGNIFICANT)],
        [row("marker_offset", SelectionCode.NOT_SIGNIFICANT)],
        [row("fuselage_drag", SelectionCode.NO_INFORMATION)],
        [row("fuselage_drag", SelectionCode.ASKED_FOR, kept=True)],
        [row("motor_lag", SelectionCode.IMMATERIAL)],
    ],
    ids=[
        "stands in for others",
        "is hidden by set-points",
        "nothing tells it",
        "asked for",
        "acts as another where it is neutral",
    ],
)
def test_of_some_terms_innovations_do_not_judge(chosen, rows) -> None:
    assert chosen(seen(rows, {name: 0.5 for name in rows[0].names[:1] if not rows[0].kept})) is None


def test_a_term_equivalent_to_another_at_neutral_starts_away_from_it(chosen) -> None:
    lag, drag = (
        row("motor_lag", SelectionCode.IMMATERIAL),
        row("fuselage_drag", SelectionCode.SIGNIFICANT, kept=True),
    )
    innovation = seen([lag, drag, RATIO], {"time_constant_second": 0.1})
    selected, found = chosen(innovation, lags=True)
    assert set(found["groups"]) == {"motor_lag", "fuselage_drag"}
    assert [r.group for r in selected.rows if r.kept] == ["motor_lag", "fuselage_drag"]
    vector = np.array([found["vector"][name] for name in innovation.space.names])
    numbers, before = map(innovation.space.numbers, (vector, innovation.vector))
    assert float(numbers.pop("time_constant_second")) == pytest.approx(0.004)
    assert numbers == {name: before[name] for name in numbers}


@pytest.mark.parametrize(
    "lag",
    [
        row("motor_lag", SelectionCode.SIGNIFICANT, kept=True),
        row("motor_lag", SelectionCode.NO_INFORMATION),
        DRAG,
    ],
    ids=["is in", "nothing tells it", "acts as nothing else"],
)
def test_nothing_else_is_put_in_unjudged(chosen, lag) -> None:
    assert chosen(seen([lag], {lag.names[0]: 0.1}), lags=True) is None


@pytest.mark.parametrize("among", [None, ["gyro_filter"], ["motor_lag"]])
def test_lags_of_some_groups_are_put_in(chosen, among) -> None:
    rows = [row(name, SelectionCode.IMMATERIAL) for name in ("motor_lag", "gyro_filter")]
    innovation = seen(rows, {"time_constant_second": 0.1, "gyro_cutoff_factor": 0.5})
    chosen(innovation, lags=True)
    selected = innovation.with_lag_terms(among)
    assert selected is not None
    assert {*selected.kept} == {*(among or ("motor_lag", "gyro_filter"))}


def test_a_short_lag_of_tachometers_is_judged_by_a_fit_with_it(chosen) -> None:
    lag = row("tachometer_lag", SelectionCode.IMMATERIAL)
    innovation = seen([lag], {"tachometer_lag": 0.06})  # its filter's smoothing is of second order
    assert chosen(innovation) is None
    selected, _ = chosen(innovation, lags=True)
    assert selected.kept == ("tachometer_lag",)


def test_an_insignificant_term_is_not_refitted(chosen) -> None:
    assert chosen(seen([row("motor_lag", SelectionCode.IMMATERIAL)], {}), lags=True) is None


@pytest.mark.parametrize(("size", "needed"), [(0.5, True), (1e-3, False)])
def test_a_term_in_the_fit_is_needed_where_samples_contradict_its_absence(size, needed) -> None:
    there = fitted_at({"fuselage_drag": size * USUAL["fuselage_drag"]}, [DRAG], [RATIO])
    assert there.called_for(["fuselage_drag"]) == (("fuselage_drag",) if needed else ())


@pytest.mark.parametrize(
    ("sizes", "needed"), [((0.0, 0.022), "derivative_filter"), ((0.01, 0.0), "gyro_filter")]
)
def test_of_two_terms_that_act_alike_the_likelier_one_is_needed(sizes, needed) -> None:
    """Neither is beside the other, and something is missing without both."""
    names = ("gyro_cutoff_factor", "derivative_cutoff_factor")
    rows = [row(name, SelectionCode.IMMATERIAL) for name in ("gyro_filter", "derivative_filter")]
    there = fitted_at(dict(zip(names, sizes, strict=True)), rows, [], dict([names]))
    assert there.called_for(["gyro_filter"]) == there.called_for(["derivative_filter"]) == ()
    assert there.called_for(["gyro_filter", "derivative_filter"]) == (needed,)


@pytest.mark.parametrize("alike", [True, False])
def test_shifts_by_omitted_terms_follow_from_innovations(alike: bool) -> None:
    """As far as they do what a coefficient does; what set-points hide stays as it was."""
    before = {"inertia_xx": 9.0, "estimate_latency": 7.0}
    found = seen(
        [DRAG], {}, {"fuselage_drag": "inertia_xx"} if alike else {}, selection_shifts=before
    )
    shifts = found.with_doubts().selection_shifts
    assert shifts["estimate_latency"] == 7.0
    assert (shifts["inertia_xx"] < 2e-3) != alike
    assert shifts["inertia_xx"] < 9.0


@pytest.mark.parametrize("alike", [True, False])
def test_an_interval_holds_that_an_omitted_term_acts_in_place_of_a_kept_one(
    monkeypatch, alike: bool
) -> None:
    """Where flights do not tell the two apart; else it is as narrow as it was."""
    monkeypatch.setattr(f"{__name__}.TOLD", 0.3)
    names, size = ("gyro_cutoff_factor", "derivative_cutoff_factor"), 0.28
    gyro, other = (row(n, SelectionCode.SIGNIFICANT) for n in ("gyro_filter", "derivative_filter"))
    there = fitted_at({names[0]: size}, [gyro], [other], dict([names]) if alike else {})
    found = there.with_doubts()
    shift = found.selection_shifts[names[0]]
    if alike:
        assert found.substitutes == {"gyro_filter": {names[1]: pytest.approx(1.2, abs=0.1)}}
        assert Z95 * shift > size
    else:
        assert not found.substitutes
        assert shift < 0.1 * size


@dataclass(frozen=True)
class Problem:
    """A problem and a filter in one: innovations show a drag only where flights are pushed."""

    space: Space
    schedule: str = "as it was"
    pushed: bool = False
    loss: float = 0.5 * FLIGHTS * STRETCHES * STEPS

    def for_problem(self, other: Problem) -> Problem:
        return other

    def information(self, objective: Problem, *_: object) -> FisherInformation:
        shown = {"fuselage_drag": 2.0} if self.pushed and objective.pushed else {}
        return information(self.space, shown, alike={"fuselage_drag": "inertia_xx"})


def test_terms_are_judged_with_model_errors_acting(monkeypatch) -> None:
    """A force that nothing explains hides a drag: with it the drag may be there."""
    plain = seen([DRAG], {})
    there = Problem(plain.space)
    wide = SimpleNamespace(objective=there, point=SimpleNamespace(coefficients=plain.vector))
    monkeypatch.setattr(refit_with_disturbances, "with_free", lambda *_: (NOBODY, wide))
    fitted = cast(Fit, SimpleNamespace(**vars(plain.fitted), criterion=NOBODY))
    model_errors = SimpleNamespace(applied_to=lambda objective: replace(objective, pushed=True))
    said = LinearisedInnovations.of(plain.selected, fitted, cast(Any, there))

    def doubt(model_errors: Any) -> float:
        return (
            said.with_model_error(model_errors, cast(Any, there))
            .with_doubts()
            .selection_shifts["inertia_xx"]
        )

    assert doubt(model_errors) > 10.0 * doubt(None) > 0.0


def test_a_value_far_from_the_innovations_estimate_is_contradicted() -> None:
    usual, said = USUAL["fuselage_drag"], seen([DRAG], {"fuselage_drag": 2.0})
    sizes = (-2.0, 0.0, 1.98, 2.0, 2.02, 2.1)
    found = [said.contradicts("fuselage_drag", size * usual) for size in sizes]
    assert found == [True, True, False, False, False, True]
    assert not said.contradicts("tachometer_lag", 1.0)  # which nobody tried
    fitted = seen([DRAG.model_copy(update={"kept": True})], {"fuselage_drag": 2.0})
    assert not fitted.contradicts("fuselage_drag", -2.0 * usual)


def test_a_steady_wind_is_a_disturbance_like_others() -> None:
    wind = SelectionRow(
        group="wind",
        names=("wind_x", "wind_y"),
        kept=False,
        reason=SelectionCode.NOT_SIGNIFICANT,
    )
    space = wide_space(())
    innovation = seen([DRAG], {}, selection_shifts={"inertia_xx": 9.0})
    alone = replace(innovation, selected=replace(innovation.selected, rows=(wind,)), space=space)
    assert alone.with_doubts().selection_shifts == {"inertia_xx": 9.0}
