"""The store of finished results, and work that goes on where an interrupted run was."""

from __future__ import annotations

import dataclasses
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from todframes.base import signals
from todframes.base.errors import DataError, OutputError
from todframes.jobs.fingerprint import code_fingerprint, fingerprint
from todframes.jobs.run import Run, StoredWork, run_stored
from todframes.jobs.store import FILE, MAGIC, Store
from todframes.observers.pyramid import PyramidObserver
from todframes.psychometrics.fit import FitSettings
from todframes.stimulus import Orientation, Stimulus


@pytest.fixture
def store(tmp_path: Path):
    signals.kept.clear()
    made = Store(tmp_path / "store" / FILE, "OUT")
    yield made
    made.close()
    signals.kept.clear()


def test_nothing_is_written_before_the_store_begins(store: Store) -> None:
    store.add([])
    assert not store.is_begun
    assert not store.path.parent.exists()
    assert len(store) == 0
    assert signals.kept == []


def test_results_are_found_again(store: Store) -> None:
    store.add([(b"a", b"1"), (b"b", b"2")])
    store.add([(b"b", b"3")])
    store.close()
    again = Store(store.path, "OUT")
    assert (again.get(b"a"), again.get(b"b"), again.get(b"c"), len(again)) == (b"1", b"3", None, 2)
    again.close()
    assert signals.kept == ["OUT"]


@pytest.mark.parametrize("damage", [b"not a store" * 100, b"", MAGIC, MAGIC + bytes(1000), b"SQLite format 3\0"])
def test_a_damaged_store_is_begun_anew(store: Store, damage: bytes) -> None:
    store.path.parent.mkdir()
    store.path.write_bytes(damage)
    assert store.is_begun
    assert store.get(b"a") is None
    store.add([(b"a", b"1")])
    store.close()
    assert store.get(b"a") == b"1"


def test_a_changed_byte_is_never_a_result(store: Store) -> None:
    added = {b"key %d" % n: b"result %d" % n for n in range(5)}
    store.add([*added.items()])
    store.close()
    whole = store.path.read_bytes()
    for place in range(len(whole)):
        store.path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        found = {key: store.get(key) for key in added}
        store.close()
        assert all(found[key] in (added[key], None) for key in added)
        first_lost = max(0, place - len(MAGIC)) * 5 // (len(whole) - len(MAGIC))
        assert sum(result is None for result in found.values()) == 5 - first_lost


def test_results_that_changed_places_are_not_found(store: Store) -> None:
    store.add([(b"a", b"1"), (b"b", b"2")])
    store.close()
    whole = store.path.read_bytes()
    size = (len(whole) - len(MAGIC)) // 2
    first, second = whole[len(MAGIC) : len(MAGIC) + size], whole[-size:]
    store.path.write_bytes(MAGIC + first[:-1] + second[-1:] + second[:-1] + first[-1:])
    assert (store.get(b"a"), store.get(b"b")) == (None, None)
    store.close()
    store.path.write_bytes(MAGIC + second + first)  # whole records are right in any order
    assert (store.get(b"a"), store.get(b"b")) == (b"1", b"2")


def test_a_store_that_is_cut_is_used_to_there(store: Store) -> None:
    store.add([(b"a", b"1"), (b"b", b"2")])
    store.close()
    whole = store.path.read_bytes()
    size = (len(whole) - len(MAGIC)) // 2
    for length in range(len(MAGIC), len(whole)):
        store.path.write_bytes(whole[:length])
        is_whole = length >= len(MAGIC) + size
        assert (store.get(b"a"), store.get(b"b")) == (b"1" if is_whole else None, None)
        store.add([(b"c", b"3")])
        store.close()
        assert (store.get(b"a"), store.get(b"c")) == (b"1" if is_whole else None, b"3")
        store.close()


def test_a_store_that_is_cut_during_the_run_has_nothing(store: Store) -> None:
    store.add([(b"a", b"1")])
    os.truncate(store.path, len(MAGIC) + 3)
    assert store.get(b"a") is None


def test_a_store_that_another_process_uses_is_refused(store: Store) -> None:
    store.add([(b"a", b"1")])
    with pytest.raises(
        OutputError, match=r"OUT: finished results cannot be kept there \(another run is writing them\)"
    ):
        Store(store.path, "OUT").get(b"a")


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (("ab", "c"), ("a", "bc")),
        ((1,), (1.0,)),
        ((1,), (True,)),
        ((None,), ("None",)),
        ((0.1,), (np.nextafter(0.1, 1.0).item(),)),
        ((0.0,), (-0.0,)),
        (([1, 2],), ([1], 2)),
        ((np.zeros(2),), (np.zeros((2, 1)),)),
        ((np.zeros(2),), (np.zeros(2, np.float32),)),
        ((FitSettings(p_correct=0.75),), (FitSettings(p_correct=0.8),)),
        ((PyramidObserver(internal_noise=0.5),), (PyramidObserver(internal_noise=0.25),)),
        ((Stimulus(1.0, 1),), (Stimulus(1.0, -1),)),
        ((Orientation.UP,), (Orientation.DOWN,)),
        ((code_fingerprint,), (fingerprint,)),
        ((b"a",), ("a",)),
    ],
)
def test_fingerprints_of_different_values_differ(one: tuple[object, ...], other: tuple[object, ...]) -> None:
    assert fingerprint(*one) != fingerprint(*other)


def test_code_in_no_file_has_no_fingerprint() -> None:
    with pytest.raises(TypeError, match="the code of builtins is in no file"):
        fingerprint(type("A", (), {"__module__": "builtins"}))


def test_fingerprints_of_equal_values_are_equal() -> None:
    assert fingerprint({"a": 1, "b": [2.0]}) == fingerprint({"b": [2.0], "a": 1})
    assert fingerprint({3, 1, 2}) == fingerprint({2, 3, 1})
    assert fingerprint(np.arange(6.0)[::2]) == fingerprint(np.array([0.0, 2.0, 4.0]))
    assert fingerprint(np.float64(0.1), np.int64(3)) == fingerprint(0.1, 3)


def test_the_code_of_a_users_module_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    found = []
    for text in ("def f(x): return x", "def f(x): return 2 * x"):
        (tmp_path / "users_own.py").write_text(text, encoding="utf-8")
        sys.modules.pop("users_own", None)
        code_fingerprint.cache_clear()
        import users_own  # type: ignore[import-not-found]

        found.append(fingerprint(users_own.f))
    assert found[0] != found[1]
    sys.modules.pop("users_own")
    code_fingerprint.cache_clear()


@dataclass
class Squares(StoredWork[int, int]):
    """Work that squares the numbers in files, and keeps a list of those it was called for."""

    folder: Path
    power: int = 2
    called: list[int] = field(default_factory=list)
    fails_at: int | None = None
    items_at_once: int = 3
    knows_stamps: bool = False
    keyed: list[int] = field(default_factory=list)

    def function(self) -> Callable[[int], int]:
        def do(item: int) -> int:
            if item == self.fails_at:
                raise DataError(f"item {item}")
            self.called.append(item)
            return int((self.folder / str(item)).read_text(encoding="utf-8")) ** self.power

        return do

    def name(self, item: int) -> str:
        return str(item)

    def key(self, item: int, *, is_done: bool) -> bytes | None:  # noqa: ARG002
        self.keyed.append(item)
        return fingerprint(self.power, (self.folder / str(item)).read_bytes(), item)

    def stamp(self, item: int) -> object:
        return (self.folder / str(item)).stat().st_mtime_ns

    def stamped_key(self, item: int, stamp: object) -> bytes | None:
        return fingerprint(self.power, item, stamp) if self.knows_stamps else None

    def encode(self, result: int) -> bytes:
        return str(result).encode()

    def decode(self, encoded: bytes) -> int:
        return int(encoded)


@pytest.fixture
def squares(tmp_path: Path) -> Squares:
    for number in range(20):
        (tmp_path / str(number)).write_text(str(number), encoding="utf-8")
    return Squares(tmp_path)


def done(work: Squares, store: Store | None) -> dict[int, int]:
    return dict(run_stored(work, range(20), Run(store=store)))  # type: ignore[arg-type]


SQUARED = {n: n * n for n in range(20)}


@pytest.mark.parametrize("fails_at", [0, 4, 11, 19])
def test_a_run_goes_on_where_it_was(squares: Squares, store: Store, fails_at: int) -> None:
    store.begin()
    with pytest.raises(DataError, match=f"item {fails_at}"):
        done(dataclasses.replace(squares, fails_at=fails_at, called=[]), store)
    kept = fails_at // 3 * 3  # all but the batch under way
    assert len(store) == kept
    assert done(squares, store) == SQUARED
    assert sorted(squares.called) == list(range(kept, 20))
    squares.called.clear()
    assert done(squares, store) == SQUARED
    assert squares.called == []


def test_what_has_changed_is_done_again(squares: Squares, store: Store, tmp_path: Path) -> None:
    store.begin()
    assert done(squares, store) == SQUARED
    (tmp_path / "7").write_text("70", encoding="utf-8")
    squares.called.clear()
    assert done(squares, store) == SQUARED | {7: 4900}
    assert squares.called == [7]
    cubes = Squares(tmp_path, power=3)
    assert done(cubes, store)[2] == 8
    assert len(cubes.called) == 20


def test_files_of_a_known_stamp_are_not_read_again(squares: Squares, store: Store, tmp_path: Path) -> None:
    squares.knows_stamps = True
    store.begin()
    assert done(squares, store) == SQUARED
    (tmp_path / "7").write_text("70", encoding="utf-8")
    os.utime(tmp_path / "8", ns=(1, 1))
    squares.called.clear()
    squares.keyed.clear()
    assert done(squares, store) == SQUARED | {7: 4900}
    assert squares.called == [7]
    assert squares.keyed == [7, 8, 7]


def test_a_file_that_is_written_meanwhile_is_not_kept(squares: Squares, store: Store, tmp_path: Path) -> None:
    """The result is of the old bytes and the key would be of the new ones."""
    store.begin()
    inner = squares.function()

    def and_write(item: int) -> int:
        result = inner(item)
        if item == 5:
            (tmp_path / "5").write_text("50", encoding="utf-8")
            os.utime(tmp_path / "5", ns=(1, 1))
        return result

    squares.function = lambda: and_write  # type: ignore[method-assign]
    assert done(squares, store)[5] == 25
    assert len(store) == 19
    squares.called.clear()
    assert done(squares, store)[5] == 2500


def test_a_forged_result_is_done_again(squares: Squares, store: Store) -> None:
    """Its checksum is right, for anybody can compute that, but it is no result of this work."""
    forged = squares.key(7, is_done=False)
    assert forged is not None
    store.add([(forged, b"no number")])
    assert done(squares, store) == SQUARED
    assert len(squares.called) == 20
    assert store.n_used == 0


def test_what_was_found_is_told_once(squares: Squares, tmp_path: Path) -> None:
    told: list[str] = []
    store = Store(tmp_path / "store" / FILE, "OUT", told.append)
    store.begin()
    with pytest.raises(DataError, match="item 9"):
        done(dataclasses.replace(squares, fails_at=9), store)
    done(squares, store)
    done(squares, store)
    assert store.n_used == 9 + 20
    assert told == ["9 of 20 parts of the work are there from an earlier run; going on with the others"]
    store.close()
