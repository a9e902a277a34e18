"""The cycle by EasyFEA, run by an interpreter that has it:

    PYTHON easyfea_cycle.py FOLDER COUNT SECONDS    # FOLDER has ventricle.msh

Writes FOLDER/easyfea.npz: nodes (n, 3) m, displacements (COUNT, n, 3) m, seconds.
"""

import sys
from importlib.metadata import version
from pathlib import Path
from time import perf_counter

import numpy as np
from EasyFEA import AlgoType, MatrixType, Mesher, Models, Simulations
from EasyFEA.FEM import FeArray, Operators
from EasyFEA.Simulations import Term

sys.path.insert(0, str(Path(__file__).parents[2]))
from studies.cardiac_cycle import ventricle as of


def pressed(group, u, elements, pressure):
    """The pressure on the deformed surface; the mesh's normals point into the cavity."""
    return Operators.NonLinear.FollowingPressure(group, u, -pressure, elements, MatrixType.mass)


def everywhere(group, elements, coef):
    """Springs or dashpots in all directions."""
    return Operators.Bilinear.UV(group, coef, dof_n=3, elements=elements)


class Ventricle(Simulations.HyperElastic):
    """EasyFEA's hyperelastic body with a pressure, springs and dashpots."""

    pressure = 0.0

    def Get_terms(self, *arguments):
        along = Operators.Bilinear.MassAlongNormal
        return [
            *super().Get_terms(*arguments),
            Term("KR", pressed, dim=2, tag="endo", pressure=self.pressure),
            *(
                Term(s, everywhere, dim=2, tag="top", coef=c)
                for s, c in zip("KC", of.TOP, strict=True)
            ),
            *(Term(s, along, dim=2, tag="epi", coef=c) for s, c in zip("KC", of.EPI, strict=True)),
        ]


def main() -> None:
    folder, count, seconds = Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
    mesh = Mesher().Mesh_Import_mesh(str(folder / "ventricle.msh"))
    places = np.asarray(mesh.groupElem.Get_GaussCoordinates_e_pg(MatrixType.rigi))
    fibres, sheets = (FeArray(vectors) for vectors in of.directions(places))
    numbers: dict[str, float] = {}
    for k, end in enumerate(("", "_f", "_s", "_fs")):
        b = of.LAW["b" + end]
        numbers |= {f"C{2 * k}": 0.5 * of.LAW["a" + end] / b, f"C{2 * k + 1}": b}
    material = Models.HyperElastic.HolzapfelOgden(
        dim=3, **numbers, K=of.BULK, Mu1=0.0, Mu2=0.0, T1=fibres, T2=sheets, ks=of.SWITCH
    )
    material.eta = of.ETA
    material.Set_active_stress_vec(fibres)
    simulation = Ventricle(mesh, material)
    step = seconds / count
    simulation.Solver_Set_Hyperbolic_Algorithm(step, algo=AlgoType.midpoint)
    simulation.rho = of.DENSITY
    halves = step * (np.arange(count) + 0.5)
    ends = of.curves(np.append(halves, seconds))
    u, begin = [], perf_counter()
    for tension, pressure in zip(*(curve[:count] for curve in ends), strict=True):
        simulation.Bc_Init()
        simulation.pressure, material.active_stress = pressure, tension
        simulation.Solve()
        simulation.Save_Iter()
        u.append(np.asarray(simulation.displacement).reshape(-1, 3).copy())
    seconds = perf_counter() - begin
    np.savez(folder / "easyfea.npz", nodes=mesh.coord, u=np.stack(u), seconds=seconds,
             version=version("easyfea"))  # fmt: skip


if __name__ == "__main__":
    main()
