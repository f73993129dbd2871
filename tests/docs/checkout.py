"""A checkout to type commands into: the project's files, in an environment that is set up."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.docs.pages import ROOT

FILES = (
    *("Makefile", "pyproject.toml", "README.md", "mkdocs.yml"),
    *("benchmarks", "configs", "docs", "examples", "lanes", "sim_jax", "tuner"),
)
PLUGINS = "xdist.plugin,jaxtyping._pytest_plugin"
"""Of pytest, what the project's settings name; others take seconds to import."""


def make_checkout(place: Path) -> Path:
    """Fill a folder with links to the project's files and to this process's environment."""
    for name in FILES:
        (place / name).symlink_to(ROOT / name)
    (place / ".venv").mkdir()
    for path in Path(sys.prefix).iterdir():
        if not path.name.startswith("."):
            (place / ".venv" / path.name).symlink_to(path)
    for mark in (".fits", ".ready"):
        (place / ".venv" / mark).touch()
    return place


def typed(line: str, place: Path) -> None:
    """Type a command into a shell, and see it succeed."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("PYTEST_", "MAKE"))}
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    needed = {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "PYTEST_PLUGINS": PLUGINS}
    done = subprocess.run(
        ["sh", "-c", line],
        cwd=place,
        env=kept | needed | {"PATH": path, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
