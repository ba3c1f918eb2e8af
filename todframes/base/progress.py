"""Progress of work, reported from where its number of parts is known."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

T = TypeVar("T")


def counted(
    parts: Iterable[T], total: int | None, progress: Callable[[int, int | None], None] | None
) -> Iterator[T]:
    """Yield the parts of some work; report after each how many are done of how many, None if that is not known."""
    for done, part in enumerate(parts, 1):
        yield part
        if progress is not None:
            progress(done, total)
