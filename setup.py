"""What pyproject.toml cannot say: a built package carries ``configs/`` as ``tuner/configs/``."""

from __future__ import annotations

import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py


class BuildWithConfigs(build_py):
    """Copies the shipped configuration; an editable install reads it where it lies."""

    def run(self) -> None:  # noqa: D102
        super().run()
        if not self.editable_mode:
            shutil.copytree("configs", Path(self.build_lib, "tuner", "configs"), dirs_exist_ok=True)


setup(cmdclass={"build_py": BuildWithConfigs})
