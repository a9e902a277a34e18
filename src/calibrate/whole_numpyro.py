"""NumPyro with all its submodules, whatever was imported before it.

ArviZ puts a lazy module in NumPyro's place. A submodule that is imported through it is complete,
but its packages do not know it: ``numpyro.distributions.distribution`` is undefined, which
``numpyro.factor`` needs. Who uses NumPyro here mends that first.
"""

import sys


def mend_numpyro() -> None:
    """Load NumPyro if it is a lazy module, and give packages the submodules they lack."""
    if "numpyro" not in sys.modules:
        return
    _ = sys.modules["numpyro"].__version__  # loads it
    for name, module in list(sys.modules.items()):
        package, _, child = name.rpartition(".")
        if name.startswith("numpyro.") and child not in vars(sys.modules[package]):
            setattr(sys.modules[package], child, module)
