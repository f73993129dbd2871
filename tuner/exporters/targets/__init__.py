"""The export targets: each module here is one, under the name that ``--format`` takes.

To add a target, add a module with a `tuner.exporters.target.Target` of the name ``TARGET``: what it
can carry, how it is written and how it is read back.
"""
