"""Files: a full disk, damaged arrays, what ships with the program."""

from __future__ import annotations

import errno
import os
import sys
from pathlib import Path

import pytest

from tuner.core.disk import (
    cache_folder,
    check_folder,
    exists,
    make_folder,
    result_folder,
    whole_file,
    write_text,
)
from tuner.core.errors import ConfigError, InputError, OutputError
from tuner.core.files import read_arrays
from tuner.core.shipped import configs_folder, find_config


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


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 not a zip", b"plain text", b"\x93NUMPY"])
def test_damaged_arrays_are_one_line(content, tmp_path):
    path = tmp_path / "x.npz"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"x\.npz: is damaged .*; run tune again"):
        read_arrays(path, remedy="run tune again")
    with pytest.raises(InputError, match="is damaged"):
        read_arrays(tmp_path / "none.npz", remedy="run tune again")


ROOT = Path(__file__).resolve().parents[3]


def test_a_checkout_reads_the_folder_at_its_root():
    assert configs_folder() == ROOT / "configs"


def test_a_path_is_a_path_and_a_bare_name_is_a_shipped_file(tmp_path):
    assert find_config("vehicles", "v.yaml", tmp_path) == tmp_path / "v.yaml"
    assert find_config("vehicles", "sub/v", tmp_path) == tmp_path / "sub" / "v"
    shipped = configs_folder() / "vehicles" / "hovergames.yaml"
    assert find_config("vehicles", "hovergames", tmp_path) == shipped
    (tmp_path / "hovergames").touch()
    assert find_config("vehicles", "hovergames", tmp_path) == tmp_path / "hovergames"
    with pytest.raises(ConfigError, match="did you mean 'hovergames'"):
        find_config("vehicles", "hovergaems", tmp_path)


def test_runs_that_begin_within_a_second_get_folders_of_their_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folders = {result_folder(None) for _ in range(5)}
    assert len(folders) == 5
    assert {folder.parent for folder in folders} == {Path("runs")}
    assert result_folder(tmp_path / "named") == result_folder(tmp_path / "named")
