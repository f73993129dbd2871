"""What jax does anew for each small program, and need do once: a run of the tests has thousands.

What is lowered, and computed, is the same. A jax that has no such functions does as ever.
"""

from __future__ import annotations

from contextlib import suppress
from functools import cache
from typing import Any

import jax
import numpy as np

with suppress(ImportError):
    from jax._src.core import stage_p
    from jax._src.interpreters import mlir


def share_contexts() -> None:
    """Have jax lower all programs in one context of MLIR: another for each is 2.6 MB and 5 ms."""
    with suppress(NameError, AttributeError):
        mlir.make_ir_context = cache(mlir.make_ir_context)


def new_context() -> None:
    """Have jax lower what follows in another context; the last goes when nothing uses it."""
    with suppress(NameError, AttributeError):
        mlir.make_ir_context.cache_clear()


def place_arrays() -> None:
    """Have ``jnp.asarray`` copy NumPy's arrays: it compiles a program for each shape to do so."""
    with suppress(NameError, AttributeError):
        staged = stage_p.impl

        def place(value: Any) -> Any:
            return jax.device_put(value.copy()) if isinstance(value, np.ndarray) else staged(value)

        stage_p.def_impl(place)
