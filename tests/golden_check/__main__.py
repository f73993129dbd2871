"""``python -m tests.golden_check DIR``: the table of all golden files of a folder."""

from __future__ import annotations

import os
import sys
from pathlib import Path

os.environ.setdefault("NPROC", "1")

import jax

jax.config.update("jax_enable_x64", True)

from tests.golden_check.files import check_of, golden_files, read  # noqa: E402

USAGE = 2


def main(arguments: list[str]) -> int:
    """Print one line per quantity; return 1 if any is out of tolerance or a file is unknown."""
    if len(arguments) != 1 or not Path(arguments[0]).is_dir():
        print("usage: python -m tests.golden_check DIR", file=sys.stderr)
        return USAGE
    files = list(golden_files(Path(arguments[0])))
    if not files:
        print(f"{arguments[0]}: no golden files (*.csv.gz)", file=sys.stderr)
        return USAGE
    print(f"{'file':32} {'quantity':34} {'rows':>6} {'worst':>9} {'tolerance':>9}  pass")
    failed = 0
    for name, path in files:
        check = check_of(name)
        if check is None:
            failed += 1
            print(f"{name:32} no check is known for this file                                 NO")
            continue
        for deviation in check(read(path)):
            failed += not deviation.passed
            print(
                f"{name:32} {deviation.quantity:34} {deviation.rows:6d} {deviation.worst:9.1e}"
                f" {deviation.tolerance:9.1e}  {'yes' if deviation.passed else 'NO'}",
                flush=True,
            )
    print("everything within tolerance" if not failed else f"{failed} out of tolerance")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
