import errno
import hashlib
from pathlib import Path

import pytest

from tuner.core.content_store import ContentStore
from tuner.core.errors import InputError


@pytest.fixture(params=["folder", "memory"])
def store(request, tmp_path):
    if request.param == "folder":
        return ContentStore(str(tmp_path / "store"))
    return ContentStore(f"memory://{tmp_path}")


def test_content_comes_back_by_its_digest(store):
    sha256 = store.put(b"a flight")
    assert sha256 == hashlib.sha256(b"a flight").hexdigest()
    assert store.put(b"a flight") == sha256
    assert store.has(sha256)
    assert store.read(sha256) == b"a flight"
    with store.reading(sha256) as file:
        assert file.read() == b"a flight"


def test_what_is_not_there_is_one_line(store):
    with pytest.raises(InputError, match="does not hold 000000000000"):
        store.read("0" * 64)


def test_what_somebody_changed_is_refused(tmp_path):
    store = ContentStore(str(tmp_path / "store"))
    sha256 = store.put(b"a flight")
    (tmp_path / "store" / sha256[:2] / sha256[2:]).write_bytes(b"something else")
    with pytest.raises(InputError, match="holds something else"):
        store.read(sha256)


def test_an_unknown_kind_of_store_is_one_line():
    with pytest.raises(InputError, match="store nowhere://x: cannot be opened"):
        ContentStore("nowhere://x")


def test_a_store_is_emptied(store):
    sha256 = store.put(b"a flight")
    store.clear()
    store.clear()
    assert not store.has(sha256)
    assert store.put(b"a flight") == sha256


def test_what_cannot_be_written_leaves_nothing(store, monkeypatch):
    def full(*_):
        raise OSError("no space left")

    sha256 = hashlib.sha256(b"a flight").hexdigest()
    monkeypatch.setattr(type(store._files), "put_file", full)
    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OSError, match="no space left"):
        store.put(b"a flight")
    assert not store.has(sha256)
    assert not store._files.find(store._root)


def test_a_file_is_taken_once_and_given_as_a_file(store, tmp_path):
    digest = hashlib.sha256(b"a flight").hexdigest()
    for name in ("first", "second"):
        file = tmp_path / name
        file.write_bytes(b"a flight")
        store.take(file, digest)
        assert not file.exists()
    store.fetch(digest, tmp_path / "fetched")
    assert (tmp_path / "fetched").read_bytes() == b"a flight"


def test_a_file_of_another_disk_appears_whole(tmp_path, monkeypatch):
    store, file, moved = ContentStore(str(tmp_path / "store")), tmp_path / "a", Path.replace

    def of_another_disk(path, target):
        if path == file:
            raise OSError(errno.EXDEV, "")
        return moved(path, target)

    file.write_bytes(b"a flight")
    monkeypatch.setattr(Path, "replace", of_another_disk)
    digest = hashlib.sha256(b"a flight").hexdigest()
    store.take(file, digest)
    assert store.read(digest) == b"a flight"
    assert not file.exists()
    assert len(store._files.find(store._root)) == 1
