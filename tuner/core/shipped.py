"""The configuration that ships: found in a checkout and in an installed package alike."""

from __future__ import annotations

import pkgutil
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from tuner.core.disk import exists, expanded
from tuner.core.errors import ConfigError, did_you_mean

Kind = Literal["vehicles", "controllers", "topics"]
KINDS: Mapping[str, Kind] = {"vehicle": "vehicles", "controller": "controllers", "topics": "topics"}
"""Key of a job file -> folder of ``configs/`` with the files that it may name."""

EXPORT_TARGETS = [
    module.name.replace("_", "-")
    for module in pkgutil.iter_modules([str(Path(__file__).parents[1] / "exporters" / "targets")])
]
"""Names that ``--format`` takes: of the modules in `tuner.exporters.targets`, not imported."""


def configs_folder() -> Path:
    """Return ``tuner/configs`` of an installed package, or ``configs`` of a checkout."""
    package = Path(__file__).resolve().parents[1]
    installed = package / "configs"
    return installed if installed.is_dir() else package.parent / "configs"


def shipped(kind: Kind) -> dict[str, Path]:
    """Return name -> file of all that ship in a folder of ``configs/``, sorted."""
    return {file.stem: file for file in sorted((configs_folder() / kind).glob("*.yaml"))}


def find_config(kind: Kind, reference: str, base: Path) -> Path:
    """Return the file that a user means.

    Parameters
    ----------
    kind
        The folder of ``configs/`` in which shipped files are looked up.
    reference
        A path, relative to ``base``, or the bare name of a shipped file such as ``hovergames``.
    base
        Folder from which relative paths count.

    Raises
    ------
    ConfigError
        A bare name is no shipped file's. Whether a path can be read is checked by its reader.
    """
    path = base / expanded(reference)
    if path.suffix in {".yaml", ".yml"} or len(Path(reference).parts) != 1 or exists(path):
        return path
    known = shipped(kind)
    if reference not in known:
        raise ConfigError(
            reference,
            f"is neither a file nor one of the shipped {kind.replace('topics', 'topic maps')}",
            did_you_mean(reference, known),
        )
    return known[reference]
