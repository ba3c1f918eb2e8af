"""Makes backgrounds like scenes, whose amplitudes fall as 1/frequency: python clouds.py FOLDER RMS SEED.

RMS is the standard deviation over the mean, 0.2 for example. There are 24 pictures in 16 bits, linear in light.
"""

import sys
from pathlib import Path

import numpy as np

import todframes as tod

SIDE, PICTURES = 512, 24

if __name__ == "__main__":
    folder, rms, rng = Path(sys.argv[1]), float(sys.argv[2]), np.random.default_rng(int(sys.argv[3]))
    folder.mkdir()
    frequency = np.hypot(np.fft.fftfreq(SIDE)[:, None], np.fft.rfftfreq(SIDE))
    frequency[0, 0] = np.inf
    for number in range(PICTURES):
        cloud = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(SIDE, SIDE))) / frequency)
        light = 0.3 * (1.0 + rms * cloud / cloud.std())
        tod.write_frame(folder / f"cloud{number:02}.png", np.clip(light, 0.0, 1.0))
