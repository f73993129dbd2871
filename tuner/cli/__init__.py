"""Arguments in, exit status out; no logic."""

from tuner.cli.ending import ending_at_once

with ending_at_once():
    from tuner.cli.app import main, program
    from tuner.core.runtime import collect_rarely, set_environment

    # before a command imports NumPy, and many other objects that stay
    set_environment()
    collect_rarely()

__all__ = ["main", "program"]
