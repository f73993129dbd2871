import hashlib
import pickle

import pytest

from tuner.engine.store import Store
from tuner.errors import InputError


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


def test_a_file_goes_in_and_comes_out_whole(store, tmp_path):
    path = tmp_path / "one.bag"
    path.write_bytes(bytes(range(256)) * 5000)
    fetched = store.fetch(store.put_file(path), tmp_path / "elsewhere" / "one.bag")
    assert fetched.read_bytes() == path.read_bytes()
    assert [file.name for file in fetched.parent.iterdir()] == ["one.bag"]


def test_a_file_that_is_there_is_not_fetched_again(store, tmp_path):
    path = tmp_path / "one.bag"
    path.write_bytes(b"a flight")
    sha256 = hashlib.sha256(b"a flight").hexdigest()
    assert not store.holds(sha256)
    assert store.fetch(sha256, path) == path


def test_what_is_not_there_is_one_line(store, tmp_path):
    nothing = "0" * 64
    for ask in (store.read, lambda sha256: store.fetch(sha256, tmp_path / "a" / "x")):
        with pytest.raises(InputError, match="does not hold 000000000000"):
            ask(nothing)
    assert not list((tmp_path / "a").iterdir())


def test_what_somebody_changed_is_refused(tmp_path):
    store = Store(str(tmp_path / "store"))
    sha256 = store.put(b"a flight")
    (tmp_path / "store" / sha256[:2] / sha256).write_bytes(b"something else")
    for ask in (store.read, lambda digest: store.fetch(digest, tmp_path / "a" / "x")):
        with pytest.raises(InputError, match="holds something else"):
            ask(sha256)
    assert not list((tmp_path / "a").iterdir())


def test_an_unknown_kind_of_store_is_one_line():
    with pytest.raises(InputError, match="store nowhere://x: cannot be reached"):
        Store("nowhere://x")


def test_a_store_is_emptied(store):
    sha256 = store.put(b"a flight")
    store.clear()
    store.clear()
    assert not store.holds(sha256)
    assert store.put(b"a flight") == sha256
