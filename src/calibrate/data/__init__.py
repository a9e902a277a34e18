"""Data of observations: read from files, written to them, and checked for its unit."""

from calibrate.data.data import read_data, read_known, write_data

__all__ = ["read_data", "read_known", "write_data"]
