"""Bags that several tests change."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.tuner.recordings import making


@pytest.fixture(scope="session")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The circle's first twelve seconds of mission, uncompressed."""
    path = tmp_path_factory.mktemp("short") / "short.bag"
    return making.rewrite(making.CIRCLE, path, chunk=1 << 18, until=1_664_800_016_000_000_000)


@pytest.fixture(autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep the user's cache out of the tests, and each test's out of the others'."""
    monkeypatch.setenv("TUNE_CACHE_DIR", str(tmp_path_factory.mktemp("cache")))
