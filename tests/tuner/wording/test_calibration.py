"""What was measured of the intervals, as the page says it."""

from benchmarks.calibration import KINDS
from tuner.uncertainty.calibration import LEVELS, Calibration, Held, calibration
from tuner.wording.result import calibration_in_words


def held(flights, share):
    coverage = dict(zip(LEVELS, (0.6, 0.8, share), strict=True))
    return Held(flights=flights, sets=12, intervals=144, coverage=coverage, least=0.8)


def test_every_kind_of_flight_is_named_with_what_it_held():
    measured = Calibration(date="2026-01-02", kinds=(held("noise alone", 0.97), held("gusts", 0.9)))
    assert calibration_in_words(measured) == (
        "Measured in simulation, 12 sets of flights of each kind, with the terms that flew in the "
        "model (2026-01-02): 97 % (noise alone) and 90 % (gusts) of the 95 % intervals held the "
        "truth."
    )


def test_what_is_shipped_is_of_every_kind_of_flight():
    shipped = calibration()
    assert [kind.flights for kind in shipped.kinds] == [kind.name for kind in KINDS]
    for kind in shipped.kinds:
        assert kind.intervals >= 12 * kind.sets
        shares = [kind.coverage[level] for level in LEVELS]
        assert shares == sorted(shares)
        assert 0.0 <= kind.least <= shares[-1] <= 1.0
