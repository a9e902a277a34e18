"""Analyses of a model or posterior: the information in data, the sensitivity of predictions.

What it exports is listed in ``__init__.pyi`` and imported when first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
