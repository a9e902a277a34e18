"""A scene of this project in FEniCSx, with forms of its own: a second opinion, and a rival in time.

Run by the study with an interpreter that has dolfinx 0.10 or newer with PETSc, which need not be
this project's:

    PYTHON fenicsx_solver.py problem.npz solutions.npz

The energy is written in UFL; residual and tangent are its derivatives. A pressure's virtual work is
``p cof(F) N . v`` on the reference facets. PETSc's SNES runs Newton's method with a direct solver.
The number of load steps, the factorisation and the line search are those that take the least time
at theta of their own (``spare``). A load step short of the last is solved to a relative residual of
1e-3, the last to ``tolerance`` times the internal forces, reactions included. Gradients of
``sum |u|^2`` over ``observed`` nodes come from the adjoint equation, one more factorisation.
"""

import contextlib
import itertools
import os
import sys
import tempfile
import time

import numpy as np

with contextlib.suppress(ImportError):  # wheels with their own PETSc and MPI
    import dolfinx_solver  # noqa: F401
import basix.ufl
import dolfinx
import ufl
from dolfinx import fem
from dolfinx.fem.petsc import (
    NonlinearProblem,
    assemble_matrix,
    assemble_vector,
)
from dolfinx.mesh import create_mesh, entities_to_geometry, exterior_facet_indices, meshtags
from mpi4py import MPI
from petsc4py import PETSc

STEPS = (1, 2, 3, 4, 6, 9)
SEARCHES = ("basic", "bt")
# The second where the tangent is symmetric as assembled: no pressure.
FACTORISATIONS = (("lu", "mumps"), ("cholesky", "mumps"), ("lu", "superlu_dist"))
LOOSE = 1e-3  # relative residual of load steps short of the last
STALLED = 1e-9  # relative length of a Newton step after which round-off is all that is left
MOST = 20  # iterations of a load step


# ---- laws ------------------------------------------------------------------------------------
def neo_hookean(F, values, fibre=None):  # noqa: ARG001 - it has none
    """Compressible, in the Lame parameters."""
    mu, lam = values["mu"], values["lam"]
    J = ufl.det(F)
    return mu / 2 * (ufl.inner(F, F) - 3) - mu * ufl.ln(J) + lam / 2 * ufl.ln(J) ** 2


def neo_hookean_E_nu(F, values, fibre=None):  # noqa: ARG001
    """The same in Young's modulus and Poisson's ratio."""
    E, nu = values["E"], values["nu"]
    lame = {"mu": E / (2 * (1 + nu)), "lam": E * nu / ((1 + nu) * (1 - 2 * nu))}
    return neo_hookean(F, lame)


def holzapfel_ogden(F, values, fibre):
    """Isochoric, fibres in tension only, kappa (J^2 - 1 - 2 ln J)."""
    a, b, a_f, b_f, kappa = (values[name] for name in ("a", "b", "a_f", "b_f", "kappa"))
    J = ufl.det(F)
    I1 = J ** (-2 / 3) * ufl.inner(F, F) - 3
    I4 = J ** (-2 / 3) * ufl.dot(F * fibre, F * fibre) - 1
    along = ufl.conditional(ufl.gt(I4, 0), ufl.exp(b_f * I4**2) - 1, 0)
    matrix = a / (2 * b) * (ufl.exp(b * I1) - 1)
    return matrix + a_f / (2 * b_f) * along + kappa * (J**2 - 1 - 2 * ufl.ln(J))


LAWS = {law.__name__: law for law in (neo_hookean, neo_hookean_E_nu, holzapfel_ogden)}


# ---- the body --------------------------------------------------------------------------------
class Body:
    """Mesh, forms and boundary conditions, made once; theta and the load are constants in them."""

    def __init__(self, problem, cache):
        self.jit = {"cache_dir": cache, "cffi_extra_compile_args": ["-O3", "-march=native"]}
        self.order = 1 if problem["elements"].shape[1] == 4 else 2
        element = basix.ufl.element("Lagrange", "tetrahedron", self.order, shape=(3,))
        # VTK's order of the six middle nodes is not basix's.
        order = [0, 1, 2, 3, 9, 8, 5, 7, 6, 4][: problem["elements"].shape[1]]
        cells = np.ascontiguousarray(problem["elements"][:, order], dtype=np.int64)
        self.mesh = create_mesh(MPI.COMM_SELF, cells, element, problem["nodes"])
        self.space = fem.functionspace(self.mesh, element)
        geometry = self.mesh.geometry
        self.dof_of_node = np.empty(len(problem["nodes"]), dtype=np.int64)
        nodes = np.asarray(geometry.input_global_indices)[geometry.dofmaps[0]]
        self.dof_of_node[nodes] = self.space.dofmap.list
        self.u = fem.Function(self.space, name="u")
        self._supports(problem)
        self._parameters(problem)
        self._forms(problem)
        observed = self.dof_of_node[problem["observed"]]
        self.observed = (3 * observed[:, None] + np.arange(3)).ravel()

    def _supports(self, problem):
        self.full = problem["prescribed"][problem["held"]]  # (k, 3) mm at the full load
        dofs = self.dof_of_node[problem["held"]].astype(np.int32)
        self.held_dofs, self.prescribed = dofs, fem.Function(self.space)
        self.support = fem.dirichletbc(self.prescribed, np.sort(dofs))

    def _parameters(self, problem):
        one = PETSc.ScalarType(1.0)
        self.theta = [fem.Constant(self.mesh, one) for _ in problem["names"]]
        self.variables = [ufl.variable(value) for value in self.theta]
        self.values = dict(zip(map(str, problem["names"]), self.variables))  # noqa: B905
        known = zip(map(str, problem["constant_names"]), problem["constants"])  # noqa: B905
        self.values |= {name: float(value) for name, value in known}
        self.load = fem.Constant(self.mesh, one)

    def _forms(self, problem):
        v, du = ufl.TestFunction(self.space), ufl.TrialFunction(self.space)
        dx = ufl.Measure("dx", self.mesh, metadata={"quadrature_degree": self.order})
        F = ufl.Identity(3) + ufl.grad(self.u)
        fibre = self._fibres(problem) if "fibres" in problem else None
        W = LAWS[str(problem["law"])](F, self.values, fibre)
        internal = ufl.derivative(W * dx, self.u, v)
        weight = fem.Constant(self.mesh, problem["body_force"].astype(PETSc.ScalarType))
        self.residual = internal - self.load * ufl.inner(weight, v) * dx
        slopes = {
            name: ufl.derivative(ufl.diff(W, each) * dx, self.u, v)
            for name, each in self.values.items()
            if name in map(str, problem["names"]) and name != "pressure"
        }
        self.symmetric = "pressed" not in problem
        if not self.symmetric:
            ds = self._pressed(problem["pressed"])
            area = ufl.det(F) * ufl.inv(F).T * ufl.FacetNormal(self.mesh)
            slopes["pressure"] = self.load * ufl.inner(area, v) * ds
            self.residual += self.values["pressure"] * slopes["pressure"]
        self.tangent = ufl.derivative(self.residual, self.u, du)
        self.compiled_tangent, self.internal = self._form(self.tangent), self._form(internal)
        self.slopes = [self._form(slopes[str(name)]) for name in problem["names"]]

    def _form(self, form):
        return fem.form(form, jit_options=self.jit)

    def _fibres(self, problem):
        """Fibres (m, 3) of linear elements, or (m, q, 3) at the ``points`` (q, 3) of others."""
        fibres, cells = problem["fibres"], self.mesh.topology.original_cell_index
        if self.order == 1:
            element, order = ("DG", 0, (3,)), [0]
            fibres = fibres[:, None]
        else:
            element = basix.ufl.quadrature_element("tetrahedron", value_shape=(3,), degree=2)
            there, _ = basix.make_quadrature(basix.CellType.tetrahedron, 2)
            away = np.abs(there[:, None] - problem["points"]).max(axis=2)
            order = away.argmin(axis=1)
            assert away.min(axis=1).max() < 1e-9, "other points than ours"
        space = fem.functionspace(self.mesh, element)
        field = fem.Function(space)
        field.x.array.reshape(-1, 3)[space.dofmap.list] = fibres[cells][:, order]
        return field

    def _pressed(self, facets):
        """Measure of the pressed facets; its rule is exact for their deformed area."""
        self.mesh.topology.create_connectivity(2, 3)
        outside = exterior_facet_indices(self.mesh.topology)
        corners = entities_to_geometry(self.mesh, 2, outside)[:, :3]
        numbers = np.sort(np.asarray(self.mesh.geometry.input_global_indices)[corners], axis=1)
        wanted = set(map(tuple, np.sort(facets[:, :3], axis=1)))
        found = outside[[tuple(row) in wanted for row in numbers]]
        assert len(found) == len(wanted), "pressed facets are not on the surface"
        tags = meshtags(self.mesh, 2, np.sort(found), np.ones(len(found), dtype=np.int32))
        degree = {"quadrature_degree": 1 if self.order == 1 else 6}
        return ufl.Measure("ds", self.mesh, subdomain_data=tags, metadata=degree)(1)

    # ---- solving -----------------------------------------------------------------------------
    def solver(self, factorisation, package, search):
        """SNES and its matrices."""
        options = {
            "snes_type": "newtonls",
            "snes_linesearch_type": search,
            "snes_max_it": MOST,
            "snes_rtol": 0.0,
            "ksp_type": "preonly",
            "pc_type": factorisation,
            "pc_factor_mat_solver_type": package,
        }
        self.count = getattr(self, "count", 0) + 1
        return NonlinearProblem(
            self.residual, self.u, J=self.tangent, bcs=[self.support],
            petsc_options_prefix=f"body{self.count}_", petsc_options=options, jit_options=self.jit,
        )  # fmt: skip

    def assign(self, theta):
        for constant, value in zip(self.theta, theta):  # noqa: B905
            constant.value = float(value)

    def forces(self):
        """Norm of the internal forces, reactions included."""
        vector = assemble_vector(self.internal)
        norm = vector.norm()
        vector.destroy()
        return norm

    def solve(self, problem, theta, tolerance=1e-8, size=None, steps=1, start=None):
        """Solve from rest or from ``start`` (dofs); iterations, or -1 where it gave up.

        size : norm of the forces that ``tolerance`` is relative to; the residual at the beginning
        of each step by default.
        """
        self.assign(theta)
        self.u.x.array[:] = 0.0 if start is None else start
        iterations = 0
        for step in range(1, steps + 1):
            self.load.value = step / steps
            self.prescribed.x.array.reshape(-1, 3)[self.held_dofs] = self.full * (step / steps)
            relative = tolerance if step == steps else max(tolerance, LOOSE)
            rtol, atol = (relative, 0.0) if size is None else (0.0, relative * size)
            problem.solver.setTolerances(rtol=rtol, atol=atol, stol=STALLED, max_it=MOST)
            problem.solve()
            iterations += problem.solver.getIterationNumber()
            if problem.solver.getConvergedReason() <= 0:
                return -1
        return iterations

    def gradient(self, problem):
        """Gradient in theta of the sum of squares of the observed displacements, by the adjoint."""
        matrix, ksp = problem.A, problem.solver.getKSP()
        matrix.zeroEntries()
        assemble_matrix(matrix, self.compiled_tangent, bcs=[self.support])
        matrix.assemble()
        ksp.setOperators(matrix)
        right, adjoint = matrix.createVecLeft(), matrix.createVecLeft()
        right.array[self.observed] = 2.0 * self.u.x.array[self.observed]
        right.array.reshape(-1, 3)[self.held_dofs] = 0.0
        ksp.solveTranspose(right, adjoint)
        found = []
        for slope in self.slopes:
            vector = assemble_vector(slope)
            found.append(-vector.dot(adjoint))
            vector.destroy()
        return np.array(found)

    def displacement(self):
        """(n, 3) mm in the file's order of nodes."""
        return self.u.x.array.reshape(-1, 3)[self.dof_of_node].copy()

    def dofs(self, displacement):
        """Displacement (n, 3) of the file's nodes as a vector of this body."""
        values = np.empty_like(displacement)
        values[self.dof_of_node] = displacement
        return values.ravel()


def timed(function, *arguments):
    """Processor seconds of a call, and what it gave."""
    begin = time.process_time()
    result = function(*arguments)
    return time.process_time() - begin, result


def with_children():
    """Processor seconds so far, those of the C compiler among them."""
    return sum(os.times()[:4])


def size_of_forces(body, theta):
    """Norm of the internal forces at the solution, reactions included."""
    for search, steps in itertools.product(SEARCHES, STEPS):
        if body.solve(body.solver("lu", "mumps", search), theta, steps=steps) > 0:
            return body.forces()
    raise SystemExit("no number of load steps reaches the whole load")


def candidates(body, spare, tolerance, size):
    """Settings by the seconds they take from rest at ``spare`` theta, the quickest first."""
    tried = []
    for (kind, package), search in itertools.product(FACTORISATIONS, SEARCHES):
        if kind == "cholesky" and not body.symmetric:
            continue
        problem = body.solver(kind, package, search)
        for steps in STEPS:
            if body.solve(problem, spare[0], tolerance, size, steps) < 0:  # also: symbolic
                continue
            runs = [timed(body.solve, problem, t, tolerance, size, steps) for t in spare[1:]]
            if all(iterations > 0 for _, iterations in runs):
                seconds = float(np.median([took for took, _ in runs]))
                tried.append((seconds, f"{package} {kind}, line search {search}", steps, problem))
            if tried and tried[-1][0] > 2.0 * min(tried)[0]:
                break  # more steps take longer
    return sorted(tried, key=lambda each: each[:3])


def main():
    problem = dict(np.load(sys.argv[1], allow_pickle=False))
    tolerance = float(problem["tolerance"])
    with tempfile.TemporaryDirectory() as cache:
        begin = with_children()
        Body(problem, cache).solver("lu", "mumps", "basic")
        first = with_children() - begin
        setup, body = timed(Body, problem, cache)
        size = size_of_forces(body, problem["spare"][0])
        tried = candidates(body, problem["spare"], tolerance, size)
        _, name, steps, solver = tried[0]
        settings = (tolerance, size, steps)
        cold = solve_all(body, solver, problem, settings, [None] * len(problem["theta"]))
        warm = solve_all(body, solver, problem, settings, problem["starts"])
    np.savez(
        sys.argv[2],
        **{f"cold_{key}": value for key, value in cold.items()},
        **{f"warm_{key}": value for key, value in warm.items()},
        compile_s=first - setup,
        setup_s=setup,
        settings=name,
        load_steps=steps,
        tried=[f"{each}, {n} load steps: {1e3 * s:.0f} ms" for s, each, n, _ in tried],
        version=dolfinx.__version__,
    )


def surely(body, solver, theta, tolerance, size, steps, start=None):
    """Iterations of a solve, begun again from rest in more load steps where it gives up."""
    iterations = body.solve(
        solver, theta, tolerance, size, 1 if start is not None else steps, start
    )
    for more in (each for each in STEPS if each > steps or start is not None):
        if iterations > 0:
            break
        iterations = body.solve(solver, theta, tolerance, size, more)
    return iterations


def solve_all(body, solver, problem, settings, starts):
    """Every theta, from rest where its start is ``None``: columns by name, with gradients."""
    columns: dict[str, list] = {}
    for theta, near in zip(problem["theta"], starts):  # noqa: B905
        start = None if near is None else body.dofs(near)
        seconds, iterations = timed(surely, body, solver, theta, *settings, start)
        u = body.displacement()
        adjoint, gradient = timed(body.gradient, solver)
        found = {
            "seconds": seconds, "iterations": iterations, "displacement": u,
            "both_s": seconds + adjoint, "gradient": gradient,
        }  # fmt: skip
        for name, value in found.items():
            columns.setdefault(name, []).append(value)
    return {name: np.array(values) for name, values in columns.items()}


if __name__ == "__main__":
    main()
