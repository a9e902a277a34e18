"""Emulators and simulators of soft-tissue mechanics.

A scene gives one potential energy. :class:`Simulator` minimises it by finite elements;
:func:`load` gives an emulator trained on it, whose ``.cache()`` is a fast differentiable map.

Importing this package turns on JAX's float64 mode, the project's only global setting. What it
exports is listed in ``__init__.pyi`` and imported when first used.
"""

import lazy_loader

from emulator.core import machine  # noqa: F401 - float64, before JAX makes its first array

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

__version__ = "0.10.0"
