"""torch-fem on a body given as arrays, run by an interpreter that has it:

    PYTHON torchfem_solver.py problem.npz solutions.npz

Compressible neo-Hookean tetrahedra under nodal forces, in one increment from rest, with the linear
solver that torch-fem chooses (MKL PARDISO where pypardiso is installed). The gradient is of
``sum |u|^2`` in both moduli, by its adjoint.
"""

import sys
from importlib.metadata import version
from time import perf_counter

import numpy as np
import torch
from torchfem import Solid
from torchfem.materials import Hyperelastic3D

torch.set_default_dtype(torch.float64)
# Tighter ones are below round-off on the larger meshes, and the increment is cut back for ever.
TOLERANCE = 1e-9


def energy(F, moduli):
    C = F.transpose(-1, -2) @ F
    ln_J = 0.5 * torch.logdet(C)
    mu, lam = moduli[0], moduli[1]
    return 0.5 * mu * (torch.einsum("ii->", C) - 3.0) - mu * ln_J + 0.5 * lam * ln_J**2


def main() -> None:
    problem = np.load(sys.argv[1], allow_pickle=False)
    nodes, elements = (torch.tensor(problem[name]) for name in ("nodes", "elements"))
    force, held = (torch.tensor(problem[name]) for name in ("force", "held"))
    columns: dict[str, list] = {"seconds": [], "gradient_s": [], "displacement": []}
    for theta in problem["theta"]:
        moduli = torch.tensor(theta, requires_grad=True)
        material = Hyperelastic3D(energy, moduli.expand(len(elements), 2))
        body = Solid(nodes, elements.long(), material)
        body.forces = force
        body.constraints[held] = True
        begin = perf_counter()
        u = body.solve(rtol=TOLERANCE, atol=TOLERANCE, differentiable_parameters=moduli)[0]
        columns["seconds"].append(perf_counter() - begin)
        begin = perf_counter()
        torch.autograd.grad((u**2).sum(), moduli)
        columns["gradient_s"].append(perf_counter() - begin)
        columns["displacement"].append(u.detach().numpy())
    np.savez(sys.argv[2], version=version("torch-fem"), **columns)


if __name__ == "__main__":
    main()
