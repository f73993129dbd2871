"""A run as one HTML page that works without a network, rendered from its folder alone."""

from tuner.report.contents import write_search, write_traces
from tuner.report.page import render

__all__ = ["render", "write_search", "write_traces"]
