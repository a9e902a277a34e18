"""FElupe with MKL PARDISO on a body given as arrays, run by an interpreter that has both:

    PYTHON felupe_solver.py problem.npz solutions.npz

Compressible neo-Hookean tetrahedra under nodal forces, by plain Newton steps from rest.
"""

import sys
from importlib.metadata import version
from time import perf_counter

import felupe
import numpy as np
from pypardiso import spsolve

TOLERANCE = 1e-10
REGIONS = {4: ("tetra", felupe.RegionTetra), 10: ("tetra10", felupe.RegionQuadraticTetra)}


def main() -> None:
    problem = np.load(sys.argv[1], allow_pickle=False)
    elements = problem["elements"].astype(int)
    kind, region_of = REGIONS[elements.shape[1]]
    held = np.zeros(len(problem["nodes"]), dtype=bool)
    held[problem["held"]] = True
    columns: dict[str, list] = {"seconds": [], "displacement": []}
    for mu, lam in problem["theta"]:
        mesh = felupe.Mesh(problem["nodes"], elements, kind)
        field = felupe.FieldContainer([felupe.Field(region_of(mesh), dim=3)])
        solid = felupe.SolidBody(felupe.NeoHookeCompressible(mu=mu, lmbda=lam), field)
        load = felupe.PointLoad(field, np.arange(mesh.npoints), values=problem["force"])
        supports = {"held": felupe.Boundary(field[0], mask=held)}
        fixed, free = felupe.dof.partition(field, supports)
        begin = perf_counter()
        felupe.newtonraphson(
            items=[solid, load], dof0=fixed, dof1=free, tol=TOLERANCE, solver=spsolve, verbose=0
        )
        columns["seconds"].append(perf_counter() - begin)
        columns["displacement"].append(field[0].values.copy())
    np.savez(sys.argv[2], version=version("felupe"), **columns)


if __name__ == "__main__":
    main()
