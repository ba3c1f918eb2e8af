"""Charts to record with a camera: on a screen, on paper, and as plates of a black body."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
