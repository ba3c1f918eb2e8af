"""Triangle Orientation Discrimination (TOD) thresholds from display frames, by a model observer."""

__version__ = "0.1.0"
