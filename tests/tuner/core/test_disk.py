"""Files: a full disk, damaged arrays, what ships with the program."""

from __future__ import annotations

import csv
import errno
import io
import os
import sys
import tracemalloc
import zipfile
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from tuner.core import files
from tuner.core.disk import (
    cache_folder,
    check_file,
    check_folder,
    exists,
    find_flights,
    make_folder,
    read_bytes,
    result_folder,
    whole_file,
    write_text,
)
from tuner.core.errors import ConfigError, InputError, OutputError
from tuner.core.files import csv_text, read_arrays
from tuner.core.shipped import configs_folder, find_config


@pytest.mark.parametrize(
    ("refusal", "words"),
    [
        (errno.ENOSPC, r"x\.csv: cannot be written: the disk is full; free"),
        (errno.EFBIG, r"x\.csv: cannot be written: it is larger than this user may write; raise"),
    ],
)
def test_a_full_disk_is_one_line_and_what_stood_there_stays(refusal, words, tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise OSError(refusal, os.strerror(refusal))

    path = tmp_path / "x.csv"
    path.write_bytes(b"before")
    monkeypatch.setattr("pathlib.Path.write_text", refuse)
    with pytest.raises(OutputError, match=words):
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


def test_a_link_stays_one_and_what_it_leads_to_is_written(tmp_path):
    there, link, dangling = tmp_path / "disk" / "x.csv", tmp_path / "x.csv", tmp_path / "y.csv"
    write_text(there, "before")
    link.symlink_to(there)
    dangling.symlink_to("disk/y.csv")
    for path in (link, dangling):
        write_text(path, "after")
        assert path.is_symlink()
        assert (there.parent / path.name).read_text() == "after"
    assert len(list(tmp_path.iterdir())) == 3
    astray = tmp_path / "astray.csv"
    astray.symlink_to(there / "z.csv")  # inside a file
    for refused in (check_file, lambda place: write_text(place, "x")):
        with pytest.raises(OutputError, match=r"it lies inside a file|it is a file"):
            refused(astray)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes")
def test_a_device_or_a_pipe_stays_what_it_is(tmp_path):
    """As of --out /dev/null for root, who may put a file in its place."""
    pipe, link = tmp_path / "pipe.csv", tmp_path / "link.csv"
    os.mkfifo(pipe)
    link.symlink_to(pipe)
    for path in (pipe, link):
        for refused in (check_file, lambda place: write_text(place, "x")):
            with pytest.raises(OutputError, match="it is a device or a pipe; name a file"):
                refused(path)
    assert pipe.is_fifo()


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
    monkeypatch.setenv("XDG_CACHE_HOME", "beside/the/flights")
    assert cache_folder().is_absolute()
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr(sys, "platform", "darwin")
    assert cache_folder() == tmp_path / "Library" / "Caches" / "multirotor-tune"


def test_without_a_home_nothing_is_kept_and_its_sign_is_a_name(monkeypatch):
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(os.path, "expanduser", str)  # as where neither HOME nor a user is known
    assert cache_folder().is_relative_to(os.devnull)
    with pytest.raises(InputError, match=r"~/x\.bag: does not exist"):
        find_flights(["~/x.bag"])


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 not a zip", b"plain text", b"\x93NUMPY"])
def test_damaged_arrays_are_one_line(content, tmp_path):
    path = tmp_path / "x.npz"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"x\.npz: is damaged \(it is no arch.*; run tune again"):
        read_arrays(path, remedy="run tune again")
    with pytest.raises(InputError, match="is damaged"):
        read_arrays(tmp_path / "none.npz", remedy="run tune again")


def test_arrays_that_unpack_to_too_much_are_not_unpacked(tmp_path, monkeypatch):
    assert files.MAX_ARRAYS <= 1 << 30
    monkeypatch.setattr(files, "MAX_ARRAYS", 1 << 26)
    path = tmp_path / "x.npz"
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("a.npy", "w") as a,
    ):
        np.lib.format.write_array_header_1_0(
            a, {"descr": "<f8", "fortran_order": False, "shape": (1 << 23,)}
        )
        for _ in range(1 << 6):
            a.write(bytes(1 << 20))
    tracemalloc.start()
    with pytest.raises(InputError, match=r"x\.npz: is damaged .*; run tune again"):
        read_arrays(path, remedy="run tune again")
    assert tracemalloc.get_traced_memory()[1] < 1 << 24
    tracemalloc.stop()


@pytest.mark.parametrize("shape", [(1 << 45,), (1 << 62, 1 << 62), (-1,)])
def test_arrays_that_claim_too_much_are_damaged(shape, tmp_path):
    path = tmp_path / "x.npz"
    with zipfile.ZipFile(path, "w") as archive, archive.open("a.npy", "w") as a:
        np.lib.format.write_array_header_1_0(
            a, {"descr": "<f8", "fortran_order": False, "shape": shape}
        )
    with pytest.raises(InputError, match=r"x\.npz: is damaged"):
        read_arrays(path, remedy="run tune again")


@pytest.mark.parametrize("damage", ["crc", "encrypted", "method"])
def test_a_damaged_archive_is_one_line(damage, tmp_path):
    path = tmp_path / "x.npz"
    np.savez(path, a=np.arange(1000.0))
    raw = bytearray(path.read_bytes())
    entry = raw.index(b"PK\x01\x02")
    match damage:
        case "crc":
            raw[500] ^= 1
        case "encrypted":
            raw[entry + 8] |= 1
        case "method":
            raw[entry + 10] = 99
    path.write_bytes(raw)
    with pytest.raises(InputError, match=r"x\.npz: is damaged"):
        read_arrays(path, remedy="run tune again")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes there")
def test_a_pipe_in_a_folder_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "x")
    (tmp_path / "zero").symlink_to("/dev/zero")
    for name in ("x", "zero"):
        with pytest.raises(InputError, match="it is no file"):
            read_arrays(tmp_path / name, remedy="run tune again")
        with pytest.raises(ConfigError, match=r"cannot be read \(it is no file\)"):
            read_bytes(tmp_path / name, most=10, remedy="run tune again")


@pytest.mark.parametrize("word", ["=cmd|' /C calc'!A0", "+1+1", "-2+3", "@SUM(A1)", "\t =1"])
def test_a_spreadsheet_takes_no_word_of_a_table_for_a_formula(word):
    text = csv_text(("name", "value"), [(word, -1.5)])
    assert list(csv.reader(io.StringIO(text, newline=""))) == [
        ["name", "value"],
        [f"'{word}", "-1.5"],
    ]


def test_a_name_with_a_line_break_makes_no_row_of_its_own():
    text = csv_text(("name",), [("a\r=1",), ("a\n=1",)])
    assert [len(row) for row in csv.reader(io.StringIO(text, newline=""))] == [1, 1, 1]
    assert "\r" not in text


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
    with ExitStack() as stack:
        folders = {stack.enter_context(result_folder(None)) for _ in range(5)}
    assert len(folders) == 5
    assert {folder.parent for folder in folders} == {Path("runs")}


@pytest.mark.skipif(sys.platform == "win32", reason="no locks of folders there")
def test_a_named_folder_is_of_one_run_at_a_time(tmp_path):
    with result_folder(tmp_path / "named") as folder:
        assert folder == tmp_path / "named"
        with pytest.raises(OutputError, match="named: another run writes there; wait for its end"):
            result_folder(folder).__enter__()
    with result_folder(folder):  # let go of
        assert not list(folder.iterdir())


def test_a_new_file_has_the_rights_that_the_user_gives_files(tmp_path):
    before = os.umask(0o077)
    try:
        write_text(tmp_path / "mine", "mine")
    finally:
        os.umask(before)
    assert (tmp_path / "mine").stat().st_mode & 0o777 == 0o600
