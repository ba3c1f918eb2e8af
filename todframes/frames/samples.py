"""The call `sample`: datasets to try the commands on, made by code."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from pathlib import Path

import numpy as np

from todframes.base.output import new_folder
from todframes.base.reading import checked
from todframes.base.user_code import registered
from todframes.display.display import Display, table_of_display
from todframes.frames.dataset import Experiment
from todframes.frames.dataset_files import write_dataset_files
from todframes.frames.files import frame_sha256, write_frame
from todframes.parameters import SampleFolder
from todframes.stimulus import ORIENTATIONS, coverage

SIDE_PX, REPETITIONS, BACKGROUND_CD_M2 = 160, 3, 22.0

THRESHOLDS = {0.6: 0.31, 0.9: 0.17, 1.4: 0.107, 2.4: 0.07}
"""Sizes in mrad, and the middle contrast of their seven, near the threshold."""


@checked
def sample(out: SampleFolder, *, exact: bool = False) -> dict[str, int]:
    """Make sample datasets to try the commands on.

    They are those that the pages name sample_frames/naked_eye and sample_frames/staring_camera: triangles as the
    naked eye sees them, and as a simulated thermal camera shows them.

    Parameters
    ----------
    out : path
        Folder for them.
    exact : bool
        Make images with exact answers instead, for any program that measures an MTF or a TOD: pictures of edges,
        triangles in noise, and truths.csv with what they hold. They are in the public domain (CC0).

    Returns
    -------
    dict of str to int
        Number of frames of each dataset, by the name of its folder.

    Raises
    ------
    OutputError
        If the place cannot be written, or a dataset is there already.

    Examples
    --------
    >>> import tempfile
    >>> import todframes as tod
    >>> tod.sample(tempfile.mkdtemp())
    {'naked_eye': 336, 'staring_camera': 162}
    """
    makers = sorted(registered("todframes.exact_samples" if exact else "todframes.samples").items())
    with new_folder(str(out)) as folder:
        return {name: maker.load()(folder / name) for name, maker in makers}


def naked_eye(folder: Path) -> int:
    """Make the paper's first experiment: triangles of both polarities on 22 cd/m² at 8 m, 32-bit EXR in cd/m².

    Each triangle is displaced by up to half a pixel of the display. Return the number of frames.
    """
    display = Display(
        eotf="linear", pixel_pitch_mm=0.25, viewing_distance_mm=8000.0, background_luminance_cd_m2=BACKGROUND_CD_M2
    )
    rows: list[Mapping[str, object]] = []
    rng = np.random.default_rng(2001)
    (folder / "frames").mkdir(parents=True)
    for size_mrad, middle in THRESHOLDS.items():
        contrasts = [float(f"{contrast:.4g}") for contrast in middle * 2.0 ** (np.arange(-3, 4) / 3.0)]
        for contrast, orientation, repetition in product(contrasts, ORIENTATIONS, range(REPETITIONS)):
            polarity = 1 if rng.random() < 0.5 else -1
            x_px, y_px = (SIDE_PX - 1) / 2 + rng.uniform(-0.5, 0.5, 2)
            triangle = coverage(
                (SIDE_PX, SIDE_PX),
                size_px=size_mrad / display.pitch_mrad,
                x_px=x_px,
                y_px=y_px,
                orientation=orientation,
            )
            name = f"frames/s{size_mrad}_c{contrast}_{orientation.value}_{repetition}.exr"
            luminance = BACKGROUND_CD_M2 * (1.0 + polarity * contrast * triangle)
            origin = {"todframes:origin": "sample_frames/make_samples.py"}
            write_frame(folder / name, luminance, pixel_type="float", attributes=origin)
            rows.append(
                {"frame": name, "orientation": orientation.value, "size_mrad": size_mrad, "contrast": contrast}
                | {"polarity": polarity, "x_px": f"{x_px:.6f}", "y_px": f"{y_px:.6f}"}
                | {"sha256": frame_sha256(folder / name)}
            )
    return write_dataset_files(
        folder,
        rows,
        display=table_of_display(display, folder),
        experiment=Experiment(level="contrast", group_by=("size_mrad",)),
        comment="Made by todframes: triangles as the naked eye sees them, in cd/m²",
    )
