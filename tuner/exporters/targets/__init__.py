"""The export targets: each module here is one, named as in ``--format``.

To add a target, add a module with a `tuner.exporters.target.Target` named ``TARGET``.
"""
