"""Matplotlib that draws to files, and colours that every reader can tell apart (Okabe and Ito)."""

import matplotlib as mpl

BLUE, VERMILION, GREEN, PINK = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
ORANGE, SKY, BLACK = "#E69F00", "#56B4E9", "#000000"
COLOURS = (BLUE, VERMILION, GREEN, PINK, ORANGE, SKY, BLACK)


def pyplot():
    """Return matplotlib.pyplot."""
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    return plt
