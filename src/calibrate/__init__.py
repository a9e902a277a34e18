"""Bayesian calibration of soft-tissue models.

A forward map (emulator, FEM, ...) and an observation make a :func:`model`; :func:`sample` draws
its posterior; :func:`certify` checks it against FEM.

What it exports is listed in ``__init__.pyi`` and imported when first used.
"""

import lazy_loader

import emulator
from calibrate.whole_numpyro import mend_numpyro

mend_numpyro()
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

__version__ = emulator.__version__
