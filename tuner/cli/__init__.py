"""Arguments in, exit status out; no logic."""

from tuner.cli.run import main, program

__all__ = ["main", "program"]
