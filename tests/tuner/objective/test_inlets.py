"""Every inlet of the simulator has one class that feeds it, and every table names the same ones."""

from dataclasses import replace
from typing import get_args, get_type_hints

import pytest

from sim_jax.inlet import Inlet, MixedInlet
from tuner.config import CHANNELS, InletName
from tuner.core.errors import RecordingError
from tuner.objective.initial_conditions import STATES
from tuner.objective.inlets import INLETS
from tuner.recordings.inspector import inlet_reports
from tuner.search.job_flights import inlet_for
from tuner.vehicle import COEFFICIENTS


def test_every_inlet_has_one_name_in_job_files_and_inspections():
    names = list(INLETS)
    assert list(get_args(InletName)) == names
    assert [inlet.name for inlet in inlet_reports({}, trajectory=False)] == names


def test_every_inlet_of_the_simulator_is_fed_by_one_class():
    feeds = [get_type_hints(type(inlet).lay_out)["return"] for inlet in INLETS.values()]
    assert len(set(feeds)) == len(feeds)
    own = {kind for kind in Inlet.__subclasses__() if kind.__module__ == Inlet.__module__}
    assert set(feeds) == own - {MixedInlet}  # a test may have brought one of its own


@pytest.mark.parametrize("inlet", INLETS.values(), ids=lambda inlet: inlet.name)
def test_channels_and_states_that_an_inlet_ignores_exist(inlet, flight):
    assert set(inlet.not_compared) <= set(CHANNELS)
    assert set(inlet.ignores) <= set(STATES)
    assert inlet.can_be_fed(flight) == all(flight.has(signal) for signal in inlet.needs)


@pytest.mark.parametrize(
    ("part", "without"),
    [("motors", {"rotor_speed"}), ("turning", {"attitude"}), ("", set())],
)
def test_a_coefficients_row_says_which_inlets_say_nothing_of_it(part, without, monkeypatch):
    row = replace(COEFFICIENTS["mass"], name="gadget", part=part)
    monkeypatch.setitem(COEFFICIENTS, "gadget", row)
    assert {name for name, inlet in INLETS.items() if "gadget" in inlet.bypasses} == without


def test_an_inlet_that_a_recording_cannot_feed_names_the_missing_signals(flight):
    without = type(flight)(**(vars(flight) | {"signals": {}}))
    with pytest.raises(RecordingError, match="no rate_setpoint and no thrust_setpoint"):
        inlet_for(without, "body_rate")
    with pytest.raises(RecordingError, match="neither a reference"):
        inlet_for(without, "auto")
