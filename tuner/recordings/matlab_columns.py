"""The columns of what a MATLAB file holds; as a program, those of a file of version 5 to 7.

It imports what that needs alone: each file is read by a process of its own.
"""

from __future__ import annotations

import io
import sys
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from tuner.core.errors import short_reason
from tuner.core.numerics import Array

#: A matrix with more columns holds no signals side by side.
MAX_MATRIX_COLUMNS = 32
#: Structures may be nested so deep.
MAX_DEPTH = 8

Described = tuple[dict[str, Array], list[str]]
"""Columns by their names, and the names of whole matrices."""


def described(content: Mapping[str, Any]) -> Described:
    """Return the columns of a file's arrays by their names."""
    whole = [name for name, value in content.items() if _is_matrix(value)]
    return dict(_columns("", content, 0)), whole


def _columns(prefix: str, value: Any, depth: int) -> Iterator[tuple[str, Array]]:
    """Yield the numeric columns of a structure, by name."""
    if isinstance(value, Mapping):
        label = value.get("label")
        for name, of in value.items() if depth < MAX_DEPTH else ():
            if not str(name).startswith("__"):
                # Simulink has a signal's name beside its values
                own = label if name == "values" and isinstance(label, str) and label else name
                yield from _columns(f"{prefix}.{own}" if prefix else str(own), of, depth + 1)
    elif isinstance(value, list) or (isinstance(value, np.ndarray) and value.dtype == object):
        for of in (
            list(value)[:MAX_MATRIX_COLUMNS] if depth < MAX_DEPTH else ()
        ):  # what Simulink calls signals
            yield from _columns(prefix, of, depth + 1)
    elif isinstance(value, np.ndarray) and value.dtype.kind in "fiub" and value.size > 1:
        if 1 in value.shape or value.ndim == 1:
            yield prefix, np.asarray(value.ravel(), dtype=np.float64)
        elif _is_matrix(value):
            table = value if value.shape[0] > value.shape[1] else value.T
            for i, column in enumerate(table.T):
                yield f"{prefix}[{i}]", np.asarray(column, dtype=np.float64)


def _is_matrix(value: object) -> bool:
    return (
        isinstance(value, np.ndarray)
        and value.ndim == 2
        and value.dtype.kind in "fiu"
        and 1 < min(value.shape) <= MAX_MATRIX_COLUMNS < max(value.shape)
    )


def main() -> None:
    """Write the columns of the MATLAB file on standard input to standard output, as npz."""
    from scipy.io import loadmat  # noqa: PLC0415 (slow to import)

    try:
        data = io.BytesIO(sys.stdin.buffer.read())
        columns, whole = described(loadmat(data, simplify_cells=True))
    except Exception as err:  # whatever a hostile file makes of the library
        sys.exit(short_reason(err))
    written = io.BytesIO()
    np.savez(written, np.array(list(columns), str), np.array(whole, str), *columns.values())
    sys.stdout.buffer.write(written.getbuffer())


if __name__ == "__main__":
    main()
