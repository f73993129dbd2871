"""Traced programs on disk: found again to the last bit, made anew whatever is wrong with them."""

import hashlib
import json
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
import pytest

from sim_jax.terms import total
from tuner import kept_programs
from tuner.objective.criterion import SegmentSums
from tuner.parallel import over_devices

BATCH = {"loads": np.linspace(0.3, 2.7, 6)}
FACTOR = np.array(1.7)


@dataclass(frozen=True)
class Settings:
    power: int = 3
    rates: tuple[float, ...] = (0.5, 2.0)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty cache, in which programs are kept."""
    monkeypatch.setenv("TUNE_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(kept_programs, "keeps_compiled", lambda: True)
    return tmp_path / "programs"


@pytest.fixture
def traced():
    """How often the function below was traced."""
    return []


@pytest.fixture
def sums(traced):
    """A function of a batch that returns what the search's does, as a new process would see it."""

    def run(name=("sums", Settings()), batch=BATCH, factor=FACTOR):
        def function(batch, factor):
            traced.append(1)
            loss = jnp.sin(batch["loads"] * factor) ** 3
            return SegmentSums(
                loss, loss[None], loss[None, None], {"b": loss, "a": loss + 1}, {}, -loss, None
            )

        return over_devices(function, name=name)(batch, factor)

    return run


def only(folder):
    (file,) = folder.iterdir()
    return file


def test_a_kept_program_is_not_traced_again_and_gives_the_same_to_the_last_bit(
    folder, sums, traced
):
    never_kept = sums(name=None)
    first = sums()
    assert len(traced) == 2
    again = sums()
    assert len(traced) == 2
    assert len(list(folder.iterdir())) == 1
    for found in (first, again):
        assert isinstance(found, SegmentSums)
        assert found.states is None
        assert found.counts == {}
        np.testing.assert_array_equal(found.loss, never_kept.loss)
        np.testing.assert_array_equal(found.squares["a"], never_kept.squares["a"])
    other_numbers = sums(factor=np.array(0.2))
    assert len(traced) == 2
    np.testing.assert_allclose(other_numbers.loss, np.sin(0.2 * BATCH["loads"]) ** 3)


def signed(content):
    return hashlib.sha256(content).digest() + content


def of_class(module, name):
    return json.dumps({"class": [module, name], "fields": []}).encode()


DAMAGES = {
    "empty": lambda _: b"",
    "cut off": lambda stored: stored[: len(stored) // 2],
    "one bit": lambda stored: stored[:-9] + bytes([stored[-9] ^ 1]) + stored[-8:],
    "another program": lambda _: signed(b'{"dict": []}\nnothing that jax wrote'),
    "no structure": lambda stored: signed(b"{\n" + stored[32:].partition(b"\n")[2]),
    "a class of others": lambda stored: signed(
        of_class("subprocess", "Popen") + b"\n" + stored[32:].partition(b"\n")[2]
    ),
    "no structure of arrays": lambda stored: signed(
        of_class("tuner.errors", "InputError") + b"\n" + stored[32:].partition(b"\n")[2]
    ),
}


@pytest.fixture
def imported(monkeypatch):
    """Which modules were imported by a name that was read."""
    names, real = [], kept_programs.importlib.import_module
    monkeypatch.setattr(
        kept_programs.importlib, "import_module", lambda name: names.append(name) or real(name)
    )
    return names


@pytest.mark.parametrize("damage", DAMAGES)
def test_what_is_damaged_is_made_anew(folder, sums, traced, imported, damage):
    right = sums()
    whole = only(folder).read_bytes()
    only(folder).write_bytes(DAMAGES[damage](whole))
    again = sums()
    assert len(traced) == 2, "it was traced anew"
    np.testing.assert_array_equal(again.loss, right.loss)
    assert only(folder).read_bytes() == whole
    assert "subprocess" not in imported


def test_other_settings_shapes_or_sources_are_other_programs(folder, sums, traced, monkeypatch):
    sums()
    sums(name=("sums", Settings(power=2)))
    sums(batch={"loads": np.ones(64)})
    monkeypatch.setattr(kept_programs, "_source", lambda: "another version")
    sums()
    assert len(traced) == 4
    assert len(list(folder.iterdir())) == 4


@pytest.mark.parametrize("name", [("sums", abs), ("sums", np.ones(3))])
def test_nothing_is_kept_whose_name_does_not_tell_all(folder, sums, name):
    np.testing.assert_allclose(sums(name=name).loss, np.sin(1.7 * BATCH["loads"]) ** 3)
    assert not folder.exists()


def test_nothing_is_kept_while_terms_of_others_take_part(folder, sums, monkeypatch):
    monkeypatch.setattr(
        total, "TERMS", (*total.TERMS, test_nothing_is_kept_whose_name_does_not_tell_all)
    )
    sums()
    assert not folder.exists()


def test_a_folder_that_cannot_be_written_is_no_fault(folder, sums):
    folder.parent.mkdir(exist_ok=True)
    folder.write_text("in the way")
    np.testing.assert_allclose(sums().loss, np.sin(1.7 * BATCH["loads"]) ** 3)


def test_what_fails_while_it_is_traced_fails_as_ever(folder):
    def function(_):
        raise KeyError("not in the batch")

    with pytest.raises(KeyError, match="not in the batch"):
        over_devices(function, name=("wrong",))(BATCH)
    assert not folder.exists()
