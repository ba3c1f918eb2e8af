"""Makes the pictures of warnings.md: python docs/reference/make_mishap_figures.py [FOLDER].

Pictures go to FOLDER/frames_go_wrong, by default in the folder of this script. The recordings are those of
tests/mishaps, with stronger triangles and less noise.
"""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from pathlib import Path

# Small matrices and images gain nothing from threads of BLAS and OpenCV.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")

import cv2
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "mishaps"))

import mishaps

HERE = Path(__file__).parent
PICTURES: dict[str, tuple[str, tuple[int, ...]]] = {
    "background_mismatch": ("dark_border", (40,)),
    "background_uneven": ("two_levels_through", (40,)),
    "bit_depth": ("twelve_bits", (40,)),
    "contrast_mismatch": ("twice_as_strong", (40,)),
    "polarity_mismatch": ("dark_triangles", (40,)),
    "saturated": ("overexposed", (40,)),
    "crushed": ("crushed_blacks", (40,)),
    "coarse_codes": ("posterised", (24,)),
    "mirrored": ("mirror", (42,)),
    "flipped": ("flip", (40,)),
    "turned": ("tilt", (40,)),
    "orientation_mismatch": ("orientation_shifted", (42,)),
    "position_offset": ("off_centre_many", (40,)),
    "position_scatter": ("hand_held", (40, 41, 45)),
    "size_mismatch": ("pitch_doubled", (40,)),
    "size_unit": ("degrees", (40,)),
    "mixed_sizes": ("mixed_sizes", (40, 41)),
    "mixed_frame_sizes": ("mixed_resolutions", (40, 41)),
}
"""The case and the shots that show what each warning means."""

STRENGTH = 4.0
"""How much stronger the triangles in the pictures are than in the recordings; the strongest has contrast 0.66."""
QUIET = 0.005
"""Standard deviation of the noise in the pictures, as a share of the background."""
ZOOM = 2
GAP_PX = 8
OUTLINE = (16, 96, 232)  # blue, green, red


def cases() -> dict[str, mishaps.Case]:
    """Return the cases by their names."""
    return {case.name: case for case in mishaps.CASES}


def stated(recording: mishaps.Recording, shot: mishaps.Shot) -> mishaps.Shot:
    """Return the triangle that the dataset says a shot shows."""
    row = recording.rows(recording.manifest())[shot.number]
    pitch = float(recording.display.get("pixel_pitch_mrad", mishaps.PITCH_MRAD))
    return replace(
        shot,
        orientation=row["orientation"],
        contrast=STRENGTH * float(row["contrast"]) * float(row.get("polarity", 1)),
        size_px=float(row["size_mrad"]) / pitch,
        x_px=float(row.get("x_px", shot.x_px)),
        y_px=float(row.get("y_px", shot.y_px)),
    )


def looked_at(codes: NDArray, recording: mishaps.Recording) -> NDArray[np.uint8]:
    """Return a frame as the dataset's display shows it, in the sRGB code values of a page, blue, green and red."""
    values = codes / (255.0 if codes.dtype == np.uint8 else 65535.0)
    eotf = recording.display.get("eotf", "linear")
    light = values if eotf == "linear" else values**2.2
    grey = mishaps.integers(mishaps.srgb(light), 255)
    return grey if grey.ndim == 3 else np.repeat(grey[..., None], 3, axis=2)


def outlined(picture: NDArray[np.uint8], shot: mishaps.Shot) -> NDArray[np.uint8]:
    """Return the picture enlarged, with the outline of a triangle that points up turned to its orientation."""
    height = mishaps.EDGE * shot.size_px * np.sqrt(0.75)
    half = mishaps.EDGE * shot.size_px / 2.0
    corners = np.array([[0.0, -2.0 * height / 3.0], [half, height / 3.0], [-half, height / 3.0]])
    for _ in range(mishaps.ORIENTATIONS.index(shot.orientation)):
        corners = corners @ np.array([[0.0, 1.0], [-1.0, 0.0]])  # a quarter turn clockwise, as y points down
    at = (corners + np.array([shot.x_px + 0.5, shot.y_px + 0.5])) * ZOOM
    large = np.repeat(np.repeat(picture, ZOOM, axis=0), ZOOM, axis=1)
    shift = 4
    points = np.rint(at * 2**shift).astype(np.int32)
    return cv2.polylines(large, [points], isClosed=True, color=OUTLINE, thickness=1, shift=shift)


def figure(case: mishaps.Case, numbers: tuple[int, ...]) -> NDArray[np.uint8]:
    """Return what the dataset says on the left, and beside it what the frames show; outlines are the dataset's."""
    recording = replace(case.recording, noise=QUIET)
    share = float(recording.display.get("background_luminance_cd_m2", mishaps.BACKGROUND)) / mishaps.BACKGROUND
    right = mishaps.Recording(noise=0.0, light=lambda light, _: light * share)
    expected = stated(recording, mishaps.series()[numbers[0]])
    tiles = [outlined(looked_at(right.frame(expected), right), expected)]
    for number in numbers:
        shot = mishaps.series()[number]
        frame = looked_at(recording.frame(replace(shot, contrast=STRENGTH * shot.contrast)), recording)
        middle = replace(shot, x_px=(frame.shape[1] - 1) / 2, y_px=(frame.shape[0] - 1) / 2)
        tiles.append(outlined(frame, stated(recording, middle)))
    height = max(tile.shape[0] for tile in tiles)
    gap = np.full((height, GAP_PX, 3), 255, np.uint8)
    padded = [np.pad(tile, ((0, height - tile.shape[0]), (0, 0), (0, 0)), constant_values=255) for tile in tiles]
    return np.hstack([part for tile in padded for part in (tile, gap)][:-1])


def main(folder: Path) -> None:
    """Draw all pictures."""
    pictures = folder / "frames_go_wrong"
    pictures.mkdir(parents=True, exist_ok=True)
    for code, (name, numbers) in PICTURES.items():
        cv2.imwrite(
            str(pictures / f"{code}.png"), figure(cases()[name], numbers), [cv2.IMWRITE_PNG_COMPRESSION, 9]
        )


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE)
