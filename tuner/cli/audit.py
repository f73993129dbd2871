"""``tune audit``: whether a simulator's model agrees with itself and with PX4's parameters."""

from __future__ import annotations

import json as json_module
from pathlib import Path

from tuner.cli.options import Quiet


def audit(
    model: Path,
    /,
    *,
    params: Path | None = None,
    run: Path | None = None,
    json: bool = False,
    quiet: Quiet = False,
) -> int:
    """Check a simulator's model against itself, PX4's parameters and physics.

    The exit status is 1 where a fault is found, 0 where none is.

    Parameters
    ----------
    model
        Audit this model (.sdf or .sdf.jinja), with what it includes from folders beside its own.
    params
        Also hold it against these parameters of PX4 (.params).
    run
        Also say how far each coefficient is from the fitted one of this result folder.
    json
        Print the faults as JSON.
    """
    from tuner.exporters.audit import audit as audited
    from tuner.result import read_run

    found = audited(model, params, None if run is None else read_run(run))
    if json:
        text = {"model": str(found.path), "faults": found.faults, "compared": found.compared}
        print(json_module.dumps(text, indent=2, ensure_ascii=False))
    else:
        from tuner.cli.tables import console

        screen = console()
        for fault in found.faults:
            screen.print(f"{found.path.name}: {fault}", markup=False, soft_wrap=True)
        for line in found.compared:
            screen.print(line, markup=False, soft_wrap=True)
        if not found.faults and not quiet:
            screen.print(f"{found.path.name}: no fault found, {found.mass:.4g} kg", markup=False)
    return 1 if found.faults else 0
