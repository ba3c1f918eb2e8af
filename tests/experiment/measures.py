"""Measures of a monitor that shows the frames of small datasets as they are."""

from todframes.experiment.monitor import Calibration

MEASURES = Calibration(
    device_pixel_ratio=1.0,
    pixel_pitch_mm=0.25,
    viewing_distance_mm=1000.0,
    gamma=2.2,
    screen_px=(1920, 1080),
    viewport_px=(1900, 1000),
)
