"""Cut the background out of a thermal frame, see README.md: `python make_background.py frame_000000.fff`."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

from todframes.recordings.opening import open_recordings

(recording,) = open_recordings([Path(sys.argv[1])])
(frame,) = recording.frames()
counts = np.asarray(frame.values)[64:448, 128:512]
cv2.imwrite(
    str(Path(__file__).with_name("counts.png")), counts.astype(np.uint16), [cv2.IMWRITE_PNG_COMPRESSION, 9]
)
