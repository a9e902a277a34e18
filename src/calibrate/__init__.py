"""Bayesian calibration of soft-tissue models.

A forward map (emulator, FEM, ...) and an observation make a :func:`model`; :func:`sample` draws
its posterior; :func:`certify` checks it against FEM.

What it exports is listed in ``__init__.pyi`` and imported when first used.
"""

import sys

import lazy_loader

import emulator


def mend_numpyro() -> None:
    """Load NumPyro if it is a lazy module, and give packages the submodules they lack.

    ArviZ puts a lazy module in NumPyro's place. A submodule that is imported through it is
    complete, but its packages do not know it: ``numpyro.distributions.distribution`` is undefined,
    which ``numpyro.factor`` needs. Who uses NumPyro here mends that first.
    """
    if "numpyro" not in sys.modules:
        return
    _ = sys.modules["numpyro"].__version__  # loads it
    for name, module in list(sys.modules.items()):
        package, _, child = name.rpartition(".")
        if name.startswith("numpyro.") and child not in vars(sys.modules[package]):
            setattr(sys.modules[package], child, module)


mend_numpyro()
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

__version__ = emulator.__version__
