"""Arrangement of triangles on frames against the manifest: mirrored, turned, or of the opposite polarity."""

from __future__ import annotations

from typing import NamedTuple

from todframes.frames.dataset import WarningCode
from todframes.stimulus import ORIENTATIONS, Orientation

TURNS = {1: "turned a quarter turn to the right", 2: "turned upside down", 3: "turned a quarter turn to the left"}
"""Phrases by number of clockwise quarter turns."""


class Arrangement(NamedTuple):
    """The triangles that frames show, against what the manifest says of them.

    `shown` has the orientation on the frames for each orientation of the manifest, in the order of `ORIENTATIONS`.
    `sign` is -1 if triangles are darker where the manifest says brighter, and the other way round.
    """

    shown: tuple[int, int, int, int] = (0, 1, 2, 3)
    sign: int = 1

    @property
    def is_mirrored(self) -> bool:
        """Whether the orientations are mirrored, at whatever axis."""
        return (self.shown[1] - self.shown[0]) % 4 == 3

    @property
    def quarter_turns(self) -> int:
        """Clockwise quarter turns of the orientations, after mirroring left and right if they are mirrored."""
        return self.shown[0]

    @property
    def phrase(self) -> str:
        """The mirroring and turning in words that follow "the triangles are"."""
        turn = TURNS.get(self.quarter_turns, "as stated")
        if not self.is_mirrored:
            return turn
        mirrored = {0: "mirrored left and right", 2: "mirrored up and down"}
        return mirrored.get(self.quarter_turns, f"mirrored left and right and {turn}")

    @property
    def mismatches(self) -> tuple[WarningCode, ...]:
        """Codes of what is not as stated; "flipped" is mirrored up and down."""
        applies: dict[WarningCode, bool] = {
            "polarity_mismatch": self.sign == -1,
            "mirrored": self.is_mirrored and self.quarter_turns != 2,
            "flipped": self.is_mirrored and self.quarter_turns == 2,
            "turned": self.quarter_turns > 0 and not self.is_mirrored,
        }
        return tuple(code for code, does_apply in applies.items() if does_apply)

    @property
    def twin(self) -> Arrangement:
        """The arrangement that is hard to tell from this one: half a turn, and the opposite polarity."""
        up, right, down, left = ((k + 2) % 4 for k in self.shown)
        return Arrangement((up, right, down, left), -self.sign)

    def of(self, orientation: Orientation) -> Orientation:
        """Return the orientation on the frames of a triangle with this orientation in the manifest."""
        return ORIENTATIONS[self.shown[orientation.quarter_turns]]


def _mirrored_and_turned(*, mirrored: bool, quarter_turns: int) -> tuple[int, int, int, int]:
    up, right, down, left = (((-k if mirrored else k) + quarter_turns) % 4 for k in range(4))
    return up, right, down, left


ARRANGEMENTS = tuple(
    Arrangement(_mirrored_and_turned(mirrored=bool(mirrored), quarter_turns=turns), sign)
    for mirrored, turns in zip((0, 1, 1, 0, 0, 0, 1, 1), (0, 0, 2, 2, 1, 3, 1, 3), strict=True)
    for sign in (1, -1)
)
"""All mirrored, turned and inverted arrangements, the more likely ones first."""
