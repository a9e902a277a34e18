"""The pressurised body of this study in legacy FEniCS (dolfin 2019), as its users write it.

Run by the study with an interpreter that has dolfin, which need not be the one of this project:

    python3 fenics_ventricle.py problem.npz solutions.npz

P1 displacements, one quadrature point, nine equal load steps, dolfin's own Newton solver for
each: residual below 1e-10 of its value at the start of the step. The pressure's virtual work uses
the deformed normal, ``-p cof(F) N . v``, and is differentiated like the other terms. dolfin's
direct solvers are timed at one extra theta, and the quickest is used for the rest.
"""

import sys
import time

import dolfin as df
import numpy as np

STEPS = 9
RELATIVE = 1e-10
SOLVERS = ("mumps", "umfpack", "petsc")
PRESSED, HELD = 1, 2


def mesh_of(problem):
    """A dolfin mesh with the node and element numbers of the file."""
    mesh, editor = df.Mesh(), df.MeshEditor()
    editor.open(mesh, "tetrahedron", 3, 3)
    editor.init_vertices(len(problem["nodes"]))
    for k, point in enumerate(problem["nodes"]):
        editor.add_vertex(k, point)
    editor.init_cells(len(problem["elements"]))
    for k, corners in enumerate(problem["elements"]):
        editor.add_cell(k, corners.astype(np.uintp))
    editor.close()
    return mesh


def facet_markers(mesh, problem):
    """Facet function: pressed facets, and facets whose corners are all held."""
    markers = df.MeshFunction("size_t", mesh, 2, 0)
    pressed = {tuple(row) for row in np.sort(problem["facets"], axis=1).tolist()}
    held = set(problem["held"].tolist())
    for facet in df.facets(mesh):
        corners = tuple(sorted(facet.entities(0).tolist()))
        if corners in pressed:
            markers[facet] = PRESSED
        elif held.issuperset(corners):
            markers[facet] = HELD
    return markers


def fibre_field(mesh, fibres):
    """The fibres as a function constant on each element."""
    space = df.VectorFunctionSpace(mesh, "DG", 0)
    field = df.Function(space)
    values = np.empty(space.dim())
    for component in range(3):
        values[space.sub(component).dofmap().dofs()] = fibres[:, component]
    field.vector().set_local(values)
    field.vector().apply("insert")
    return field


class Body:
    """Forms and boundary conditions, made once; theta and the pressure are constants in them."""

    def __init__(self, problem):
        self.pressure_at_full_load = float(problem["pressure"])
        mesh = mesh_of(problem)
        markers = facet_markers(mesh, problem)
        space = df.VectorFunctionSpace(mesh, "P", 1)
        self.u = df.Function(space)
        self.theta = [df.Constant(1.0) for _ in range(4)]
        self.pressure = df.Constant(0.0)
        self.support = df.DirichletBC(space, df.Constant((0.0, 0.0, 0.0)), markers, HELD)
        self.vertex_dofs = df.vertex_to_dof_map(space)
        held = np.zeros(space.dim(), dtype=bool)
        held[list(self.support.get_boundary_values())] = True
        held = np.flatnonzero(held[self.vertex_dofs].reshape(-1, 3).all(axis=1))
        assert np.array_equal(held, np.sort(problem["held"])), "held nodes are not whole facets"
        fibre = fibre_field(mesh, problem["fibres"])
        self._forms(mesh, markers, space, fibre, float(problem["kappa"]))

    def _forms(self, mesh, markers, space, fibre, kappa):
        a, b, a_f, b_f = self.theta
        v, du = df.TestFunction(space), df.TrialFunction(space)
        ds = df.Measure("ds", domain=mesh, subdomain_data=markers)
        F = df.variable(df.Identity(3) + df.grad(self.u))
        J = df.det(F)
        I1 = J ** (-2.0 / 3.0) * df.inner(F, F) - 3.0
        I4 = J ** (-2.0 / 3.0) * df.dot(F * fibre, F * fibre) - 1.0
        W = (
            a / b * (df.exp(b * I1) - 1.0)
            + a_f / b_f * (df.exp(b_f * I4**2) - 1.0)
            + df.Constant(kappa) * (J**2 - 1.0 - 2.0 * df.ln(J))
        )
        area = J * df.inv(F).T * df.FacetNormal(mesh)
        self.residual = df.inner(df.diff(W, F), df.grad(v)) * df.dx + self.pressure * df.inner(
            area, v
        ) * ds(PRESSED)
        self.tangent = df.derivative(self.residual, self.u, du)
        x = df.SpatialCoordinate(mesh) + self.u
        # Normals point out of the tissue, into the cavity; the fixed lid cancels in differences.
        self.enclosed = -df.dot(x, area) / 3.0 * ds(PRESSED)

    def solver(self, linear_solver):
        """dolfin's Newton solver."""
        problem = df.NonlinearVariationalProblem(
            self.residual, self.u, self.support, J=self.tangent
        )
        solver = df.NonlinearVariationalSolver(problem)
        options = solver.parameters["newton_solver"]
        options["linear_solver"] = linear_solver
        options["relative_tolerance"] = RELATIVE
        options["absolute_tolerance"] = 1e-30
        options["maximum_iterations"] = 50
        options["report"] = False
        return solver

    def solve(self, solver, theta):
        """Solve from rest at ``theta``; the number of iterations, or -1 when it gave up."""
        for constant, value in zip(self.theta, theta):  # noqa: B905 - older Pythons run this
            constant.assign(float(value))
        self.u.vector().zero()
        iterations = 0
        for step in range(1, STEPS + 1):
            self.pressure.assign(self.pressure_at_full_load * step / STEPS)
            try:
                iterations += solver.solve()[0]
            except RuntimeError:
                return -1
        return iterations

    def displacement(self):
        """(n, 3) in the file's node order."""
        return self.u.vector().get_local()[self.vertex_dofs].reshape(-1, 3)

    def volume(self):
        """Signed volume between the pressed facets and the origin."""
        return df.assemble(self.enclosed)


def timed(function, *arguments):
    begin = time.perf_counter()
    result = function(*arguments)
    return time.perf_counter() - begin, result


def quickest(body, theta):
    """The direct solver that is quickest on this body, and the times of all."""
    seconds = {}
    for name in SOLVERS:
        if df.has_lu_solver_method(name):
            took, iterations = timed(body.solve, body.solver(name), theta)
            if iterations > 0:
                seconds[name] = took
    return min(seconds, key=seconds.get), seconds


def main():
    df.set_log_level(df.LogLevel.ERROR)
    compiler = df.parameters["form_compiler"]
    compiler["quadrature_degree"] = 1
    compiler["optimize"] = True
    compiler["cpp_optimize"] = True
    compiler["cpp_optimize_flags"] = "-O3 -march=native"
    problem = np.load(sys.argv[1], allow_pickle=False)
    compiling, _ = timed(lambda: Body(problem).solver("default"))
    setup, body = timed(Body, problem)
    body.solve(body.solver("default"), problem["warm_up"][0])
    unloaded = (body.u.vector().zero(), body.volume())[1]
    name, candidates = quickest(body, problem["warm_up"][1])
    solver = body.solver(name)
    rows = []
    for theta in problem["theta"]:
        seconds, iterations = timed(body.solve, solver, theta)
        rows.append((seconds, iterations, body.displacement(), body.volume() - unloaded))
    seconds, iterations, displacement, volume = map(np.array, zip(*rows))  # noqa: B905
    np.savez(
        sys.argv[2],
        seconds=seconds,
        iterations=iterations,
        displacement=displacement,
        volume_change=volume,
        compile_seconds=max(compiling - setup, 0.0),
        setup_seconds=setup,
        linear_solver=name,
        candidates=list(candidates),
        candidate_seconds=list(candidates.values()),
        version=df.__version__,
    )


if __name__ == "__main__":
    main()
