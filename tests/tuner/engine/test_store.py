import hashlib
import pickle

import pytest

from tuner.core.errors import InputError
from tuner.engine.store import Store


@pytest.fixture(params=["folder", "memory"])
def store(request, tmp_path):
    if request.param == "folder":
        return Store(str(tmp_path / "store"))
    return Store(f"memory://{tmp_path}")


def test_content_comes_back_by_its_digest(store):
    sha256 = store.put(b"a flight")
    assert sha256 == hashlib.sha256(b"a flight").hexdigest()
    assert store.put(b"a flight") == sha256
    assert store.holds(sha256)
    assert store.read(sha256) == b"a flight"
    assert pickle.loads(pickle.dumps(store)).read(sha256) == b"a flight"


def test_what_is_not_there_is_one_line(store):
    with pytest.raises(InputError, match="does not hold 000000000000"):
        store.read("0" * 64)


def test_what_somebody_changed_is_refused(tmp_path):
    store = Store(str(tmp_path / "store"))
    sha256 = store.put(b"a flight")
    (tmp_path / "store" / sha256[:2] / sha256).write_bytes(b"something else")
    with pytest.raises(InputError, match="holds something else"):
        store.read(sha256)


def test_an_unknown_kind_of_store_is_one_line():
    with pytest.raises(InputError, match="store nowhere://x: cannot be reached"):
        Store("nowhere://x")


def test_a_store_is_emptied(store):
    sha256 = store.put(b"a flight")
    store.clear()
    store.clear()
    assert not store.holds(sha256)
    assert store.put(b"a flight") == sha256


def test_what_cannot_be_written_leaves_nothing(store, monkeypatch):
    def full(*_):
        raise OSError("no space left")

    sha256 = hashlib.sha256(b"a flight").hexdigest()
    monkeypatch.setattr(store._files, "mv", full)
    with pytest.raises(OSError, match="no space left"):
        store.put(b"a flight")
    assert not store.holds(sha256)
    assert not store._files.find(store._root)
