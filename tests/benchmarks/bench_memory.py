"""Scoring frames in memory against the inner products and the resampling alone."""

from __future__ import annotations

import time

import numpy as np
from timing import Row

import todframes as tod
from todframes.observers.pyramid import PyramidObserver
from todframes.observers.retina import resample
from todframes.stimulus import ORIENTATIONS, Stimulus, coverage

N_FRAMES, SIDE, PITCH_MRAD, SIZE_MRAD = 1000, 512, 0.7, 10.0
DISTINCT = 20
MIDDLE = (SIDE - 1) / 2
REPEATS = 7


def rows() -> list[Row]:
    """Median over pairs, run in turn, of processor times."""
    shown = [(ORIENTATIONS[k % 4], 0.02 + 0.01 * (k // 4 % 5)) for k in range(N_FRAMES)]
    size_px = SIZE_MRAD / PITCH_MRAD
    distinct = [
        1.0 + contrast * coverage((SIDE, SIDE), size_px=size_px, x_px=MIDDLE, y_px=MIDDLE, orientation=orientation)
        for orientation, contrast in shown[:DISTINCT]
    ]
    arrays = [(50.0 * image).astype(np.float32) for image in distinct]
    frames = [arrays[k % DISTINCT] for k in range(N_FRAMES)]
    display = tod.Display(eotf="linear", pixel_pitch_mrad=PITCH_MRAD, background_luminance_cd_m2=50.0)
    orientation, level = zip(*shown, strict=True)

    readout = PyramidObserver().readout(Stimulus(SIZE_MRAD))
    rows, columns = readout.grid.touched([MIDDLE], [MIDDLE], pixel_pitch_mrad=PITCH_MRAD, shape=(SIDE, SIDE))
    parts = [image[slice(*rows), slice(*columns)] - 1.0 for image in distinct]

    def score() -> None:
        tod.score_frames(
            frames,
            orientation=orientation,
            level=level,
            size_mrad=SIZE_MRAD,
            display=display,
            fit=tod.FitSettings(resamples=0),
        )

    def needed() -> None:
        for k in range(N_FRAMES):
            image = resample(
                parts[k % DISTINCT],
                readout.grid,
                x_px=MIDDLE,
                y_px=MIDDLE,
                pixel_pitch_mrad=PITCH_MRAD,
                first_row=rows[0],
                first_column=columns[0],
            )
            readout.scores(image)

    score()
    times = []
    for _ in range(REPEATS):
        started = time.process_time()
        score()
        between = time.process_time()
        needed()
        times.append((between - started, time.process_time() - between))
    ratio = sorted(whole / part for whole, part in times)[REPEATS // 2]
    whole_ms, part_ms = (1e3 * min(one) / N_FRAMES for one in zip(*times, strict=True))
    name = f"score {N_FRAMES} frames in memory ({whole_ms:.2f} ms each) ÷ resampling and products ({part_ms:.2f})"
    return [Row(name, ratio, "<= 1.4")]
