"""Simulated against recorded flights, predictions of held-out ones, flights nobody flew."""
