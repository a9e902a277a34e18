"""The network emulator."""

from emulator.network.emulator import CachedEmulator, Emulator
from emulator.network.files import load, save_emulator, shipped
from emulator.network.graph import AugmentedGraph, GraphOptions, augment
from emulator.network.pignn import Architecture

__all__ = [
    "Architecture",
    "AugmentedGraph",
    "CachedEmulator",
    "Emulator",
    "GraphOptions",
    "augment",
    "load",
    "save_emulator",
    "shipped",
]
