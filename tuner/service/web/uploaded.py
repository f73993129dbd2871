"""The job file that a visitor types or drops: YAML, read with the same limits as any other."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from tuner.errors import ConfigError
from tuner.yaml_files.document import read_yaml


def typed_settings(text: str) -> dict[str, Any]:
    """Return the keys of a job file that was typed.

    Raises
    ------
    ConfigError
        It is no YAML, or no mapping of keys to values.
    """
    if not text.strip():
        return {}
    with tempfile.TemporaryDirectory(prefix="tune-settings-") as folder:
        file = Path(folder) / "tune.yaml"
        file.write_text(text, encoding="utf-8", errors="replace")
        try:
            data = read_yaml(file).data
        except ConfigError as error:
            raise ConfigError("settings", error.what, error.remedy) from None
    if not isinstance(data, dict):
        raise ConfigError("settings", "are no keys with values", "write them as in tune.yaml")
    return data
