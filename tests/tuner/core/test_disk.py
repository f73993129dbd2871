import errno
import os
import sys

import pytest

from tuner.core.disk import cache_folder, check_folder, exists, make_folder, whole_file, write_text
from tuner.core.errors import InputError, OutputError


@pytest.fixture
def full(monkeypatch):
    """A disk on which nothing more fits."""

    def refuse(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("pathlib.Path.write_text", refuse)


@pytest.mark.usefixtures("full")
def test_a_full_disk_is_one_line_and_what_stood_there_stays(tmp_path):
    path = tmp_path / "x.csv"
    path.write_bytes(b"before")
    with pytest.raises(OutputError, match=r"x\.csv: cannot be written: the disk is full; free"):
        write_text(path, "after")
    assert path.read_bytes() == b"before"
    assert [file.name for file in tmp_path.iterdir()] == ["x.csv"]


def test_an_interruption_leaves_what_stood_there(tmp_path):
    path = tmp_path / "x.csv"
    path.write_text("before")

    def interrupted():
        with whole_file(path) as unfinished:
            unfinished.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text() == "before"
    assert [file.name for file in tmp_path.iterdir()] == ["x.csv"]


def test_a_refusal_that_nobody_foresaw_is_reported_with_its_own_words(tmp_path):
    error = OSError(errno.EIO, os.strerror(errno.EIO))
    with pytest.raises(OutputError, match="Input/output error"), whole_file(tmp_path / "x"):
        raise error


def test_folders_are_made_with_those_above_them(tmp_path):
    check_folder(tmp_path / "a" / "b")
    assert not (tmp_path / "a").exists()
    make_folder(tmp_path / "a" / "b")
    check_folder(tmp_path / "a" / "b")
    (tmp_path / "file").touch()
    for path in (tmp_path / "file", tmp_path / "file" / "x"):
        with pytest.raises(OutputError):
            check_folder(path)
        with pytest.raises(OutputError):
            make_folder(path)


def test_looking_for_a_path_may_be_refused(tmp_path):
    assert exists(tmp_path)
    assert not exists(tmp_path / "x" / "y")
    with pytest.raises(InputError, match="cannot be read"):
        exists(tmp_path / ("x" * 300))


def test_cache_folder_follows_the_platform(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "multirotor-tune"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr(sys, "platform", "darwin")
    assert cache_folder() == tmp_path / "Library" / "Caches" / "multirotor-tune"
