"""The scoring of datasets by an observer to obtain thresholds, and thresholds of the naked eye."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
