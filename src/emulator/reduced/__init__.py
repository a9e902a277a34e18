"""Reduced models: fitted to FEM runs on one geometry."""

from emulator.reduced.pod_gp import ReducedForward, fit_reduced

__all__ = ["ReducedForward", "fit_reduced"]
