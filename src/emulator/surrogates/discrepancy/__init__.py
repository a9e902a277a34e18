"""What is left between a map and FEM, learned from a few runs and their slopes."""

from emulator.surrogates.discrepancy.fit import Mean, Residual, fit_residual

__all__ = ["Mean", "Residual", "fit_residual"]
