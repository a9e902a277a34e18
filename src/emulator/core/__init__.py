"""The foundation of all other packages, without mechanics or statistics.

==================  ==========================================================================
``errors``          errors of one line, and the one wording of an unknown name
``schema``          plain data from TOML and JSON files, checked and read into dataclasses
``store``           files that are written whole or not at all; arrays as safetensors
``representation``  how objects show themselves in a terminal and in a notebook
``progress``        progress of long work
``machine``         cores, memory and devices of this machine; the switch to float64
==================  ==========================================================================
"""
