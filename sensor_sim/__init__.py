"""Display frames and TOD curves from a sensor's parameters, when there is no camera.

import sensor_sim as ss

ss.curve("sample_frames/staring_camera.toml", size_detectors=[3, 4, 6]).plot_tod()
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
