"""Diagnosis: the triangle that frames show, against what their dataset says, and the words for the difference.

It measures frames, finds triangles, warns about frames that go wrong, and explains missing thresholds.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
