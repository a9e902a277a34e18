"""Material cards of other programs, one program a file.

Each file has a :class:`~emulator.neighbours.cards.card.Program`: the forms in which it has our
laws, its units, and how it takes a body with fibres. :data:`PROGRAMS` is the only list of them. To
add a program, write its file and add a line here; ``docs/neighbours.md`` has a column for each.
"""

from emulator.neighbours.cards.abaqus import ABAQUS
from emulator.neighbours.cards.calculix import CALCULIX
from emulator.neighbours.cards.card import ExportedBody, Form, Program, form_of, write_card
from emulator.neighbours.cards.febio import FEBIO
from emulator.neighbours.cards.felupe import FELUPE
from emulator.neighbours.cards.pulse import PULSE
from emulator.neighbours.cards.svmultiphysics import SVMULTIPHYSICS

PROGRAMS: dict[str, Program] = {
    program.name: program for program in (FEBIO, ABAQUS, FELUPE, PULSE, SVMULTIPHYSICS, CALCULIX)
}
"""The programs by the word that names each on the command line."""

__all__ = ["PROGRAMS", "ExportedBody", "Form", "Program", "form_of", "write_card"]
