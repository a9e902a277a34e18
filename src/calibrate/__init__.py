"""Bayesian calibration of soft-tissue models.

A forward map (emulator, FEM, ...) and an observation make a :func:`model`; :func:`sample` draws
its posterior; :func:`certify` checks it against FEM.

What it exports is listed in ``__init__.pyi`` and imported when first used.
"""

import sys

import lazy_loader

import emulator

if "numpyro" in sys.modules:  # perhaps ArviZ's lazy module, see calibrate.arviz: load it now
    _ = sys.modules["numpyro"].__version__

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

__version__ = emulator.__version__
