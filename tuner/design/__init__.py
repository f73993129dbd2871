"""Experiment design: which flight, flown next, would narrow which interval."""
