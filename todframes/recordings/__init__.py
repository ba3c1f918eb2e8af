"""Charts to record with a camera, recordings, and the way from them to datasets."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
