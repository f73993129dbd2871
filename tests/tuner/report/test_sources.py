from types import SimpleNamespace

from tuner.report.sections.tables import sources
from tuner.uncertainty.records import Sources


def contents(**by_name):
    run = SimpleNamespace(result=SimpleNamespace(sources=by_name))
    return SimpleNamespace(run=run)


def source(deviation, flights=1.4e-5):
    return Sources(
        ground=1.5e-5,
        ground_error=1e-7,
        flights=flights,
        flights_error=None if flights is None else 1e-8,
        both=1.4e-5,
        both_error=1e-8,
        deviation=deviation,
    )


def test_a_conflict_is_marked_and_what_flights_do_not_say_is_none():
    section = sources(
        contents(
            motor_constant=source(-10.0),
            moment_constant=source(1.0),
            inertia_xx=source(None, flights=None),
        )
    )
    said = [row[-1].text for row in section.tables[0].rows]
    assert said == ["● conflict", "○ yes", "flights do not identify it"]


def test_a_fit_without_ground_measurements_has_no_such_section():
    assert sources(contents()) is None
    assert sources(SimpleNamespace(run=None)) is None
