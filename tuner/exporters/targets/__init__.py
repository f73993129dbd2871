"""The export targets: each module here is one, under the name that ``--format`` takes.

To add a target, add a module with a `tuner.exporters.target.Target` of the name ``TARGET``: what it
can carry, how it is written and how it is read back.
"""

import pkgutil

NAMES = [module.name.replace("_", "-") for module in pkgutil.iter_modules(__path__)]
"""Of the targets; known without importing them."""
