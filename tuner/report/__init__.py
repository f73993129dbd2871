"""A run as one HTML page that works without a network, rendered from its folder alone."""

from tuner.report.page import render
from tuner.report.record import write_search, write_traces

__all__ = ["render", "write_search", "write_traces"]
