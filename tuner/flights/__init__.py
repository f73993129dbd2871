"""Recordings in, `Flight` out: nothing downstream of this room knows what a bag is."""

from tuner.flights.flight import SIGNALS, Flight, InitialState, Note, Series
from tuner.flights.load import load_flight, load_flights

__all__ = ["SIGNALS", "Flight", "InitialState", "Note", "Series", "load_flight", "load_flights"]
