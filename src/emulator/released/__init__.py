"""Data released with Dalton et al. (2023)."""
