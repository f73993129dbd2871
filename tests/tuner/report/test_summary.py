"""The page's first sentences name each verdict as it is in result.json."""

from types import SimpleNamespace

from tuner.report.summary import _counted, summary
from tuner.uncertainty.verdict import Verdict


def test_held_coefficients_are_counted_as_held():
    verdicts = [Verdict.WELL_KNOWN, Verdict.WELL_KNOWN, Verdict.HELD, Verdict.NOT_IDENTIFIABLE]
    assert _counted(verdicts) == (
        "2 are well known, 1 is held at its initial value and 1 is not identifiable"
    )
    assert _counted([Verdict.WELL_KNOWN] * 3) == "all 3 are well known"
    assert _counted([Verdict.HELD] * 2) == "all 2 are held at their initial values"
    two = _counted([Verdict.HELD, Verdict.WELL_KNOWN, Verdict.HELD])
    assert two == "2 are held at their initial values and 1 is well known"


def test_an_examination_without_a_fit_is_summed_up_from_what_is_known():
    known = {
        "mass": SimpleNamespace(verdict=Verdict.WEAKLY_KNOWN, fitted=True),
        "quadratic": SimpleNamespace(verdict=Verdict.NOT_IDENTIFIABLE, fitted=False),
    }
    knowledge = SimpleNamespace(coefficients=known, flights=["circle"])
    (sentence,) = summary(SimpleNamespace(run=None, knowledge=knowledge, proposals=None))
    assert sentence == (
        "1 coefficient was examined on 1 flight, nothing fitted: 1 is weakly known."
    )
