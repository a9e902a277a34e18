"""Calibration of external problems: outputs as data, tables of runs, and first files."""
