"""Commands that hand results to other programs."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from dataclasses import asdict

from calibrate.cli.words import Answer, command, flag, option


def _add_program(parser: ArgumentParser) -> None:
    from emulator.neighbours.cards import PROGRAMS

    names = ", ".join(PROGRAMS)
    parser.add_argument("--to", metavar="PROGRAM", help=f"one of {names}", required=True)


@command(
    option("folder", "RUN", "folder of calibrate infer, of one body"),
    _add_program,
    option("--out", "DIR", "a new folder for the cards and a README", required=True),
    option("--draws", "N", "cards of N draws beside mean and median (default 20)", type=int,
           default=20),
    flag("--mesh", "write the body and its fibres in the program's format, too"),
    help="a posterior as material cards of another program",
    description="Write mean, median and draws of a posterior as material cards of another finite "
    "element program, in its units and its form of the law. A law that the program does not have "
    "is refused.",
    epilog="example: calibrate export RUN --to febio --out DIR --draws 50 --mesh",
)  # fmt: skip
def export(arguments: Namespace) -> Answer:
    """Export a posterior."""
    from calibrate.neighbours import export_posterior

    result = export_posterior(
        arguments.folder, arguments.to, arguments.out, draws=arguments.draws, mesh=arguments.mesh
    )
    lines = [
        f"law '{result.law}' for {result.program}: {len(result.files)} files in {result.folder}"
    ]
    lines += result.differs or ("the energies are equal",)
    return Answer(asdict(result), "\n".join(lines))
