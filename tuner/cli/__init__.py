"""Arguments in, exit status out; no logic."""

from tuner.cli.app import main, program
from tuner.core.runtime import set_environment

set_environment()  # before a command imports NumPy

__all__ = ["main", "program"]
