"""Calibration of external problems: their outputs as data, tables of runs, and their first files."""
