"""Triangle Orientation Discrimination (TOD) thresholds from display frames, by a model observer.

import todframes as tod

tod.score("sample_frames/naked_eye").plot_tod()
"""

import lazy_loader

__version__ = "0.3.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
