"""What other programs make of a card, by the formulas of their manuals and sources.

A card is read from its text, and each program's energy is evaluated with NumPy at F + i h e: the
imaginary part is the stress (complex step), exact to rounding. The formulas are not ours: factors,
switches and penalties are the programs'.
"""

import re
import sys
from types import ModuleType, SimpleNamespace
from xml.etree import ElementTree

import numpy as np


def stress(energy, F):
    """First Piola-Kirchhoff stress (3, 3) of an energy that takes complex F."""
    P, h = np.zeros((3, 3)), 1e-30
    for i, j in np.ndindex(3, 3):
        step = np.zeros((3, 3), complex)
        step[i, j] = 1j * h
        P[i, j] = np.imag(energy(F + step)) / h
    return P


def positive(x):
    return x if np.real(x) > 0.0 else 0.0 * x


def eigenvalues(C):
    """Eigenvalues of a symmetric matrix, their imaginary parts to first order: also if equal."""
    values, vectors = np.linalg.eigh(np.real(C))
    return values + 1j * np.einsum("ik,ij,jk->k", vectors, np.imag(C), vectors)


class Measures:
    """Invariants of a complex F; those of axes a, b are a . C b, isochoric."""

    def __init__(self, F):
        self.C = F.T @ F
        self.J = np.linalg.det(F)
        self.bar = self.J ** (-2.0 / 3.0) * self.C
        self.I1 = np.trace(self.bar)
        self.I2 = 0.5 * (self.I1**2 - np.trace(self.bar @ self.bar))

    def of(self, a, b=None):
        return a @ self.bar @ (a if b is None else b)

    def stretches(self, power):
        return np.sum(eigenvalues(self.bar) ** (power / 2.0))


# FEBio


def _febio_solid(node, m, axes):
    """Deviatoric energy of a material, by its type."""
    p = {each.tag: float(each.text) for each in node if each.tag[-1] != "d" and _is_number(each)}
    kind = node.get("type")
    if kind == "uncoupled solid mixture":
        return sum(_febio_solid(each, m, axes) for each in node.findall("solid"))
    if kind == "Mooney-Rivlin":
        return p["c1"] * (m.I1 - 3) + p["c2"] * (m.I2 - 3)
    if kind == "Yeoh":
        return sum(p[f"c{k}"] * (m.I1 - 3) ** k for k in range(1, 7) if f"c{k}" in p)
    if kind == "Ogden":
        terms = [k for k in range(1, 7) if f"c{k}" in p]
        return sum(p[f"c{k}"] / p[f"m{k}"] ** 2 * (m.stretches(p[f"m{k}"]) - 3) for k in terms)
    if kind == "Veronda-Westmann":
        exponential = p["c1"] * (np.exp(p["c2"] * (m.I1 - 3)) - 1)
        return exponential - p["c1"] * p["c2"] / 2 * (m.I2 - 3)
    if kind == "fiber-exp-pow-uncoupled":
        direction = np.array([float(x) for x in node.find("fiber").text.split(",")]) @ axes
        power = positive(m.of(direction) - 1) ** p["beta"]
        return p["ksi"] / (p["alpha"] * p["beta"]) * (np.exp(p["alpha"] * power) - 1)
    assert kind == "Holzapfel-Gasser-Ogden"
    energy, gamma = p["c"] / 2 * (m.I1 - 3), np.deg2rad(p["gamma"])
    for sign in (1, -1):
        a = np.cos(gamma) * axes[0] + sign * np.sin(gamma) * axes[1]
        E = positive(p["kappa"] * (m.I1 - 3) + (1 - 3 * p["kappa"]) * (m.of(a) - 1))
        energy = energy + p["k1"] / (2 * p["k2"]) * (np.exp(p["k2"] * E**2) - 1)
    return energy


def _is_number(node):
    return re.fullmatch(r"[-+.\de]+", node.text or "") is not None


def febio(card, axes):
    node = ElementTree.fromstring(card).find("Material/material")
    p = {each.tag: float(each.text) for each in node if _is_number(each)}

    def neo_hookean(F):
        mu, J = p["E"] / (2 * (1 + p["v"])), np.linalg.det(F)
        lam = p["v"] * p["E"] / ((1 + p["v"]) * (1 - 2 * p["v"]))
        return mu / 2 * (np.trace(F.T @ F) - 3) - mu * np.log(J) + lam / 2 * np.log(J) ** 2

    def fung(F):
        mu = np.array(
            [
                p["G12"] + p["G31"] - p["G23"],
                p["G12"] - p["G31"] + p["G23"],
                -p["G12"] + p["G31"] + p["G23"],
            ]
        )
        E1, E2, E3 = p["E1"], p["E2"], p["E3"]
        compliance = [
            [1 / E1, -p["v12"] / E1, -p["v31"] / E3],
            [-p["v12"] / E1, 1 / E2, -p["v23"] / E2],
            [-p["v31"] / E3, -p["v23"] / E2, 1 / E3],
        ]
        lam = np.linalg.inv(compliance) - 2 * np.diag(mu)
        E = 0.5 * (F.T @ F - np.eye(3))
        along = np.array([a @ E @ a for a in axes])
        square = np.array([a @ E @ E @ a for a in axes])
        Q = (2 * mu @ square + along @ lam @ along) / p["c"]
        return p["c"] / 2 * (np.exp(Q) - 1) + p["k"] / 2 * np.log(np.linalg.det(F)) ** 2

    def uncoupled(F):
        m = Measures(F)
        assert node.find("pressure_model").text == "Abaqus (GOH)"
        return _febio_solid(node, m, axes) + p["k"] / 2 * ((m.J**2 - 1) / 2 - np.log(m.J))

    return {"neo-Hookean": neo_hookean, "Fung-ortho-compressible": fung}.get(
        node.get("type"), uncoupled
    )


# Abaqus and CalculiX


def blocks(card):
    """Keyword lines without the star, each with all numbers or words of its data."""
    found = []
    for line in card.splitlines():
        if line.startswith("*"):
            found.append((line[1:], []))
        else:
            assert all(len(word.strip()) <= 20 for word in line.split(","))
            found[-1][1].extend(word.strip() for word in line.split(","))
    return found


def _isotropic(keyword, d):
    """Energy in MPa of *HYPERELASTIC or *ELASTIC."""

    def elastic(F):
        mu, lam = d[0] / (2 * (1 + d[1])), d[0] * d[1] / ((1 + d[1]) * (1 - 2 * d[1]))
        small = 0.5 * (F + F.T) - np.eye(3)
        return mu * np.sum(small * small) + lam / 2 * np.trace(small) ** 2

    def polynomial(F):
        m, kind = Measures(F), keyword.split(", ", 1)[1]
        if kind == "NEO HOOKE":
            shape, D = d[0] * (m.I1 - 3), d[1:]
        elif kind == "MOONEY-RIVLIN":
            shape, D = d[0] * (m.I1 - 3) + d[1] * (m.I2 - 3), d[2:]
        elif kind == "YEOH":
            shape, D = sum(d[k] * (m.I1 - 3) ** (k + 1) for k in range(3)), d[3:]
        else:
            n = int(re.fullmatch(r"OGDEN, N=(\d)", kind)[1])
            pairs = zip(d[0 : 2 * n : 2], d[1 : 2 * n : 2], strict=True)
            shape, D = sum(2 * mu / a**2 * (m.stretches(a) - 3) for mu, a in pairs), d[2 * n :]
        # Abaqus has no term where D is 0.
        return shape + sum((m.J - 1) ** (2 * k + 2) / x for k, x in enumerate(D) if x)

    return elastic if keyword == "ELASTIC" else polynomial


def abaqus(card, axes):
    read = dict(blocks(card))
    (keyword,) = [key for key in read if "ELASTIC" in key]
    d = [float(x) for x in read[keyword]]
    if not keyword.startswith("ANISO"):
        return lambda F: 1e3 * _isotropic(keyword, d)(F)
    assert keyword == "ANISOTROPIC HYPERELASTIC, HOLZAPFEL, LOCAL DIRECTIONS=2"
    local = read["ORIENTATION, NAME=FIBRES, LOCAL DIRECTIONS=2"]
    assert local[:3] == ["FIBRE_AXES", "3", "0."]
    families = np.array(local[3:], float).reshape(2, 3) @ axes
    C10, D, k1, k2, kappa = d

    def energy(F):
        m = Measures(F)
        U = C10 * (m.I1 - 3) + ((m.J**2 - 1) / 2 - np.log(m.J)) / D
        for a in families:
            E = positive(kappa * (m.I1 - 3) + (1 - 3 * kappa) * (m.of(a) - 1))
            U = U + k1 / (2 * k2) * (np.exp(k2 * E**2) - 1)
        return 1e3 * U

    return energy


def calculix(card, axes):
    read = dict(blocks(card))
    if "MATERIAL, NAME=TISSUE" in read:
        (keyword,) = [key for key in read if "ELASTIC" in key]
        d = [float(x) for x in read[keyword]]
        assert all(abs(x) > 1e-10 for x in d)  # smaller D are replaced
        return lambda F: 1e3 * _isotropic(keyword, d)(F)
    assert "MATERIAL, NAME=ELASTIC_FIBER_TISSUE" in read
    d = [float(x) for x in read["USER MATERIAL, CONSTANTS=10"]]
    assert read["ORIENTATION, NAME=FIBRES, SYSTEM=RECTANGULAR"] == ["FIBRE_AXES"]
    local = np.array([axes[1], np.cross(axes[0], axes[1]), axes[0]])

    def energy(F):
        m = Measures(F)
        U = d[0] * (m.I1 - 3) + (m.J - 1) ** 2 / d[1]
        for ax, ay, k1, k2 in (d[2:6], d[6:10]):
            a = np.array([ax, ay, np.sqrt(1 - ax**2 - ay**2)]) @ local
            U = U + k1 / (2 * k2) * (np.exp(k2 * positive(m.of(a) - 1) ** 2) - 1)
        return 1e3 * U

    return energy


# Python modules: run with stand-ins of the programs' classes


def run(card, **modules):
    """Names of a module's text, with these modules in place of installed ones."""
    before = {name: sys.modules.get(name) for name in modules}
    names = {}
    try:
        sys.modules.update(modules)
        exec(compile(card, "card", "exec"), names)
    finally:
        for name, module in before.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module
    return names


def _module(name, **content):
    module = ModuleType(name)
    vars(module).update(content)
    return module


def felupe(card, axes):
    linalg = _module("linalg", det=np.linalg.det, eigvalsh=eigenvalues)
    functions = ("sqrt", "exp", "log", "trace", "sum", "einsum")
    math = _module(
        "tensortrax.math",
        linalg=linalg,
        maximum=lambda x, y: positive(x - y) + y,
        **{name: getattr(np, name) for name in functions},
    )
    parent = _module("tensortrax", math=math)

    def neo_hookean(mu, lmbda):
        def energy(F):
            J = np.linalg.det(F)
            return mu / 2 * (np.trace(F.T @ F) - 3) - mu * np.log(J) + lmbda / 2 * np.log(J) ** 2

        return energy

    peer = _module(
        "felupe",
        Hyperelastic=lambda fun, **k: lambda F: fun(F.T @ F, **k),
        NeoHookeCompressible=neo_hookean,
        LinearElastic=lambda E, nu: _isotropic("ELASTIC", [E, nu]),
    )
    modules = {"tensortrax.math": math, "tensortrax": parent, "felupe": peer}
    return run(card, **modules)["umat"](axes[0], axes[1])


def pulse(card, axes):
    units = {"kPa": 1.0, "dimensionless": 1.0}

    def holzapfel_ogden(f0=None, s0=None, use_subplus=True, use_heaviside=True, **given):
        p = {"a_f": 0.0, "a_s": 0.0, "a_fs": 0.0, **given}

        def fibres(I4, a, b):
            x = positive(I4 - 1) if use_subplus else I4 - 1
            on = 1.0 if not use_heaviside or np.real(I4) >= 1 else 0.0
            return a / (2 * b) * on * (np.exp(b * x**2) - 1)

        def energy(C):
            W = p["a"] / (2 * p["b"]) * (np.exp(p["b"] * (np.trace(C) - 3)) - 1)
            W = W + (fibres(f0 @ C @ f0, p["a_f"], p["b_f"]) if p["a_f"] else 0)
            W = W + (fibres(s0 @ C @ s0, p["a_s"], p["b_s"]) if p["a_s"] else 0)
            if p["a_fs"]:
                W = W + p["a_fs"] / (2 * p["b_fs"]) * (np.exp(p["b_fs"] * (f0 @ C @ s0) ** 2) - 1)
            return W

        return energy

    def penalty(kappa):
        return lambda J: kappa / 4 * (J**2 - 1 - 2 * np.log(J))

    peer = _module(
        "pulse",
        Variable=lambda value, unit: units[unit] * value,
        HolzapfelOgden=holzapfel_ogden,
        NeoHookean=lambda mu: lambda C: mu / 2 * (np.trace(C) - 3),
        compressibility=SimpleNamespace(Compressible2=penalty),
    )
    names = run(card, pulse=peer)
    try:
        material = names["material"](f0=axes[0], s0=axes[1])
        volume = names["compressibility"]()
    except TypeError as error:
        raise AssertionError(card) from error
    return lambda F: material(Measures(F).bar) + volume(np.linalg.det(F))


# svMultiPhysics


def svmultiphysics(card, axes):
    root = ElementTree.fromstring(f"<r>{card}</r>")
    outer = {node.tag: node.text.strip() for node in root if not len(node)}
    node = root.find("Constitutive_model")
    p = {each.tag: float(each.text) for each in node}
    assert outer["Dilational_penalty_model"] == "ST91"
    K, f, s = float(outer["Penalty_parameter"]), axes[0], axes[1]
    E, nu = float(outer["Elasticity_modulus"]), float(outer["Poisson_ratio"])

    def switched(x, a, b):
        chi = 1 - 1 / (np.exp(p["k"] * x) + 1)
        return chi * a / (2 * b) * (np.exp(b * x**2) - 1)

    def energy(F):
        m = Measures(F)
        U = K / 4 * (m.J**2 - 1 - 2 * np.log(m.J))
        if node.get("type") == "neoHookean":
            return U + E / (2 * (1 + nu)) / 2 * (m.I1 - 3)
        if node.get("type") == "Mooney-Rivlin":
            return U + p["c1"] * (m.I1 - 3) + p["c2"] * (m.I2 - 3)
        assert node.get("type") == "HolzapfelOgden"
        U = U + p["a"] / (2 * p["b"]) * (np.exp(p["b"] * (m.I1 - 3)) - 1)
        U = U + switched(m.of(f) - 1, p["a4f"], p["b4f"])
        U = U + switched(m.of(s) - 1, p["a4s"], p["b4s"])
        return U + p["afs"] / (2 * p["bfs"]) * (np.exp(p["bfs"] * m.of(f, s) ** 2) - 1)

    return energy


ENERGIES = {
    "febio": febio,
    "abaqus": abaqus,
    "felupe": felupe,
    "pulse": pulse,
    "svmultiphysics": svmultiphysics,
    "calculix": calculix,
}
"""From a card's text and the axes (3, 3) of fibre, sheet and normal to the energy in kPa of F."""
