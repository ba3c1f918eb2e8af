"""The list on disk that `import` keeps of each frame."""

from __future__ import annotations

import tempfile
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from todframes.base.errors import OutputError
from todframes.importing.filmed_trials import Correction, Corrections
from todframes.importing.spool import Spool


def test_objects_come_back_in_order_however_adding_and_reading_alternate() -> None:
    spool: Spool[tuple[int, bytes]] = Spool()
    wanted = [(k, bytes(k % 7)) for k in range(50)]
    for k, item in enumerate(wanted):
        spool.append(item)
        assert spool[k // 2] == wanted[k // 2]
    assert len(spool) == 50
    assert list(spool) == wanted
    assert [spool[k] for k in (49, 0, 25)] == [wanted[49], wanted[0], wanted[25]]
    with pytest.raises(IndexError, match="50"):
        spool[50]


def test_memory_grows_by_eight_bytes_an_object() -> None:
    """2,000 arrays of 1 kB: 16 kB of places, in an array that grows by an eighth too much; in memory 2 MB."""
    spool: Spool[np.ndarray] = Spool()
    spool.append(np.zeros(128))
    tracemalloc.start()
    for k in range(2000):
        spool.append(np.full(128, float(k)))
    kept, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert kept < 40_000
    assert spool[2000][0] == 1999.0


def test_a_full_folder_is_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("needs /dev/full")
    monkeypatch.setattr(tempfile, "TemporaryFile", lambda: full.open("r+b", buffering=0))
    monkeypatch.setattr(tempfile, "gettempdir", lambda: str(tmp_path))
    spool: Spool[int] = Spool()
    with pytest.raises(
        OutputError, match=r"cannot be written \(No space left on device\); import keeps some 1 kB"
    ):
        spool.append(1)


def test_corrections_are_found_by_their_numbers() -> None:
    corrections = Corrections()
    for number in (2, 3, 7):
        corrections.add(number, Correction(number, -number, 10.0))
    assert corrections.get(3) == Correction(3.0, -3.0, 10.0)
    assert [corrections.get(number) for number in (0, 4, 8)] == [None] * 3
