"""Arguments in, exit status out; no logic."""

from tuner.cli.run import main

__all__ = ["main"]
