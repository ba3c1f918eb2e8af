"""Rows of finished results, and work that goes on where an interrupted run was."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from todframes.base import signals
from todframes.base.errors import DataError, OutputError
from todframes.jobs.fingerprint import code_fingerprint, fingerprint
from todframes.jobs.rows import Rows
from todframes.jobs.run import Run, StoredWork, run_stored
from todframes.observers.pyramid import PyramidObserver
from todframes.psychometrics.fit import FitSettings
from todframes.stimulus import Orientation, Stimulus


@pytest.fixture
def rows(tmp_path: Path):
    signals.kept.clear()
    yield Rows(tmp_path / "rows", "OUT")
    signals.kept.clear()


def kept(rows: Rows, identity: bytes = b"settings") -> dict[str, bytes]:
    with rows.of_work(identity) as (found, _):
        return found


def test_rows_are_found_again_by_their_work(rows: Rows) -> None:
    assert not rows.folder.exists()
    assert kept(rows) == {} and signals.kept == []
    with rows.of_work(b"settings") as (_, add):
        add("a", b"1")
        add("b", bytes(range(256)))
        add("b", b"3")
        with (
            pytest.raises(
                OutputError, match=r"OUT: finished results cannot be kept there \(another run is writing"
            ),
            rows.of_work(b"settings"),
        ):
            pass
    assert kept(rows) == {"a": b"1", "b": b"3"}
    assert kept(rows, b"other settings") == {}
    assert signals.kept == ["OUT"]
    rows.forget()
    assert kept(rows) == {}


def test_a_line_that_was_being_written_is_cut_off(rows: Rows) -> None:
    with rows.of_work(b"settings") as (_, add):
        add("a", b"1")
        add("b", b"2")
    (path,) = rows.folder.iterdir()
    whole = path.read_bytes()
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        first = {"a": b"1"} if length > whole.index(b"\n") else {}
        with rows.of_work(b"settings") as (found, add):
            assert found == first
            add("c", b"3")
        assert kept(rows) == first | {"c": b"3"}


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

    def function(self) -> Callable[[int], int]:
        def do(item: int) -> int:
            if item == self.fails_at:
                raise DataError(f"item {item}")
            self.called.append(item)
            return int((self.folder / str(item)).read_text(encoding="utf-8")) ** self.power

        return do

    def name(self, item: int) -> str:
        return str(item)

    def identity(self) -> bytes:
        return fingerprint(self.power)

    def item_identity(self, item: int) -> str:
        return f"{item}-{(self.folder / str(item)).stat().st_mtime_ns}"

    def decode(self, encoded: bytes) -> int:
        return int(encoded)


@pytest.fixture
def squares(tmp_path: Path) -> Squares:
    for number in range(20):
        (tmp_path / str(number)).write_text(str(number), encoding="utf-8")
    return Squares(tmp_path)


def done(work: Squares, rows: Rows | None) -> dict[int, int]:
    return dict(run_stored(work, range(20), Run(store=rows)))  # type: ignore[arg-type]


SQUARED = {n: n * n for n in range(20)}


@pytest.mark.parametrize("fails_at", [0, 4, 11, 19])
def test_a_run_goes_on_where_it_was(squares: Squares, tmp_path: Path, fails_at: int) -> None:
    told: list[str] = []
    rows = Rows(tmp_path / "rows", "OUT", told.append)
    with pytest.raises(DataError, match=f"item {fails_at}"):
        done(dataclasses.replace(squares, fails_at=fails_at, called=[]), rows)
    assert done(squares, rows) == SQUARED
    assert sorted(squares.called) == list(range(fails_at, 20))
    squares.called.clear()
    assert done(squares, rows) == SQUARED
    assert squares.called == []
    assert rows.n_used == fails_at + 20
    going_on = f"{fails_at} of 20 parts of the work are there from an earlier run; going on with the others"
    nothing_left = "20 of 20 parts of the work are there from an earlier run; nothing is left to do"
    assert told == [going_on if fails_at else nothing_left]


def test_what_has_changed_is_done_again(squares: Squares, tmp_path: Path) -> None:
    told: list[str] = []
    rows = Rows(tmp_path / "rows", "OUT", told.append)
    assert done(squares, rows) == SQUARED
    (tmp_path / "7").write_text("70", encoding="utf-8")
    squares.called.clear()
    assert done(squares, rows) == SQUARED | {7: 4900}
    assert squares.called == [7]
    told.clear()
    cubes = Squares(tmp_path, power=3)
    rows = Rows(tmp_path / "rows", "OUT", told.append)
    assert done(cubes, rows)[2] == 8
    assert len(cubes.called) == 20
    assert told == ["what an earlier run has finished is of other settings or versions; beginning anew"]


def test_a_result_of_another_program_is_done_again(squares: Squares, tmp_path: Path) -> None:
    rows = Rows(tmp_path / "rows", "OUT")
    with rows.of_work(squares.identity()) as (_, add):
        add(squares.item_identity(7), b"no number")
    assert done(squares, rows) == SQUARED
    assert (len(squares.called), rows.n_used) == (20, 0)
