"""The project's tests; ``checked`` turns sim_jax's annotations into run-time checks."""

from beartype import BeartypeConf, beartype

checked = beartype(conf=BeartypeConf(is_pep484_tower=True))  # an int passes for a float
