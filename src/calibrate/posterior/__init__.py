"""Posteriors: drawn, kept, judged and compared."""

from calibrate.posterior.posterior import Posterior, read_tree, sample

__all__ = ["Posterior", "read_tree", "sample"]
