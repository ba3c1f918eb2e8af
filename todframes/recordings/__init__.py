"""Charts to record with a camera, and the way from recordings of them to datasets."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
