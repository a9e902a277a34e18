"""Discrepancy models: what a map leaves of FEM, learned from a few runs and their sensitivities."""

from emulator.surrogates.discrepancy.fit import Mean, fit_discrepancy
from emulator.surrogates.discrepancy.model import Discrepancy, Warp

__all__ = ["Discrepancy", "Mean", "Warp", "fit_discrepancy"]
