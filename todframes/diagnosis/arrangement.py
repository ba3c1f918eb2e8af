"""The arrangements of triangles on frames against the manifest: mirrored, turned, or of the opposite polarity."""

from __future__ import annotations

from typing import NamedTuple

from todframes.frames.dataset import WarningCode
from todframes.stimulus import ORIENTATIONS, Orientation


class Arrangement(NamedTuple):
    """A change of all orientations that a camera or an import may cause, with its words.

    `shown` is the orientation on the frames for each of the manifest, in the order of `ORIENTATIONS`. `code` is
    that of the warning about it, None: as stated. `words` is a clause with {are} for its verb, `question` that for
    somebody whose answers are all wrong. `sign` is -1 if triangles are darker where the manifest says brighter, or
    the other way round.
    """

    name: str
    shown: tuple[int, int, int, int]
    code: WarningCode | None
    words: str
    question: str
    sign: int = 1

    @property
    def mismatches(self) -> tuple[WarningCode, ...]:
        """Codes of the differences from what is stated."""
        polarity: tuple[WarningCode, ...] = ("polarity_mismatch",) if self.sign == -1 else ()
        return polarity if self.code is None else (*polarity, self.code)

    def of(self, orientation: Orientation) -> Orientation:
        """Return the orientation on the frames of a triangle with this orientation in the manifest."""
        return ORIENTATIONS[self.shown[orientation.quarter_turns]]


TURNED = tuple(
    Arrangement(*one)
    for one in (
        ("as stated", (0, 1, 2, 3), None, "all {are} as stated", ""),
        ("mirrored", (0, 3, 2, 1), "mirrored", "left and right {are} swapped", "Is the camera mirrored?"),
        ("flipped", (2, 1, 0, 3), "flipped", "up and down {are} swapped", "Are the frames upside down?"),
        ("half_turn", (2, 3, 0, 1), "turned", "all orientations {are} turned by 180°",
         "Is the camera upside down?"),
        ("quarter_turn_right", (1, 2, 3, 0), "turned", "all orientations {are} turned clockwise by 90°",
         "Is the camera turned?"),
        ("quarter_turn_left", (3, 0, 1, 2), "turned", "all orientations {are} turned counter-clockwise by 90°",
         "Is the camera turned?"),
        ("anti_transposed", (1, 0, 3, 2), "mirrored", "up and right, and down and left, {are} swapped",
         "Is the camera turned and mirrored?"),
        ("transposed", (3, 2, 1, 0), "mirrored", "up and left, and down and right, {are} swapped",
         "Is the camera turned and mirrored?"),
    )
)  # fmt: skip
"""The eight arrangements of the stated polarity, the more likely ones first."""

ARRANGEMENTS = tuple(one._replace(sign=sign) for one in TURNED for sign in (1, -1))
"""All arrangements, of either polarity."""
