"""Maps from theta to displacement: the protocol, and all kinds of maps."""

from emulator.surrogates.emulator import CachedEmulator, Emulator, load, save_emulator
from emulator.surrogates.folders import shipped
from emulator.surrogates.network.graph import AugmentedGraph, augment
from emulator.surrogates.network.pignn import Architecture

__all__ = [
    "Architecture",
    "AugmentedGraph",
    "CachedEmulator",
    "Emulator",
    "augment",
    "load",
    "save_emulator",
    "shipped",
]
