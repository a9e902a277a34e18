"""Are all modes found? Posteriors of 2 to 27 modes whose masses and evidence are in closed form.

    python -m studies.samplers.modes [--problems 60] [--seed 0] [--certify]

The data sees some unknowns through a zigzag, a function that is linear in each of several pieces of
the unknown's range. Each piece holds a mode, and a piece that is s times as steep holds an s-th of
the mass. A posterior is *wrong* if the share of a mode of 2 % or more is off by 40 %, and *silent*
if it has no warning.
"""

import argparse
import warnings
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import jax.numpy as jnp
import numpy as np
from studies.certificate.problems import ExactSimulator, linear

import calibrate as cal
import emulator as em
from emulator.geometry.generators.box import box
from emulator.scenes import Parameter, Scene, Support

SD, NODES = 0.2, 18
COUNTS = ((2,), (3,), (2, 2), (2, 3), (2, 2, 2), (3, 3), (2, 2, 2, 2), (3, 3, 3), (2,), (2, 2))
WIDTHS = (0.02, 0.01, 0.003)  # sd of a mode in the widest piece, shares of a range
STEEPNESS = (1.0, 1.5, 2.5, 4.0, 9.0)


@dataclass(frozen=True)
class Zigzag:
    """A function of x in [0, 1] that runs up and down ``height`` over pieces of these widths."""

    ends: tuple[float, ...]

    def __call__(self, x):
        rising = [k % 2 == 0 for k in range(len(self.ends) - 1)]
        pieces = [
            (x - low) / (high - low) if up else (high - x) / (high - low)
            for (low, high), up in zip(
                zip(self.ends, self.ends[1:], strict=False), rising, strict=True
            )
        ]
        inner = jnp.asarray(self.ends[1:-1])
        return jnp.select([x < end for end in inner], pieces[:-1], pieces[-1])

    def preimages(self, value):
        """The places where the function has this value, and the mass of the mode at each."""
        widths = np.diff(self.ends)
        up = np.arange(len(widths)) % 2 == 0
        low = np.asarray(self.ends[:-1])
        return low + widths * np.where(up, value, 1.0 - value), widths / widths.sum()


@dataclass(frozen=True, eq=False)
class Modes:
    name: str
    model: Any
    data: np.ndarray
    forward: Any
    bends: tuple[Zigzag, ...]
    log_evidence: float
    shares: np.ndarray

    def of(self, unit):
        """The mode (s,) that positions (s, p) in the box belong to."""
        mode = np.zeros(len(unit), int)
        for k, bend in enumerate(self.bends):
            mode = mode * (len(bend.ends) - 1) + np.digitize(unit[:, k], bend.ends[1:-1])
        return mode


def body(unknowns: int) -> Scene:
    """A block of as many regions as there are unknowns, each of a stiffness of its own."""
    mesh = box((8.0, 2.0, 2.0), (8, 1, 1))
    regions = np.arange(len(mesh.elements)) * unknowns // len(mesh.elements)
    return Scene(
        name="block",
        mesh=mesh,
        law=em.find_law("neo_hookean"),
        parameters=tuple(Parameter(f"stiffness_{k}", "", 1.0, 2.0) for k in range(unknowns)),
        constants={"mu": 1.0, "lam": 1.0},
        regions=regions,
        supports=(Support("left"),),
    )


def problem(unknowns: int, counts: tuple[int, ...], steep: float, width: float, seed: int) -> Modes:
    """Return the posterior of ``unknowns`` parameters with the product of ``counts`` modes."""
    scene, rng = body(unknowns), np.random.default_rng([unknowns, *counts, seed])
    bends = []
    for count in counts:
        widths = np.where(np.arange(count) % 2 == 0, 1.0, 1.0 / steep)
        bends.append(Zigzag((0.0, *np.cumsum(widths / widths.sum()))))
    nodes = np.sort(rng.choice(len(scene.mesh.nodes), NODES, replace=False))
    size = 3 * NODES
    # Each feature is known to ``width`` of its range, with correlations.
    matrix = rng.normal(size=(len(scene.mesh.nodes), 3, unknowns))
    matrix += 0.5 * rng.normal(size=(1, 3, unknowns))
    matrix *= SD / (width * np.sqrt(size))

    def feature(theta):
        unit = theta - 1.0
        bent = [bend(unit[k]) for k, bend in enumerate(bends)]
        return jnp.stack([*bent, *unit[len(bends) :]])

    forward = linear(scene, jnp.asarray(matrix), jnp.zeros((len(scene.mesh.nodes), 3)), feature)
    truth = np.array([*rng.uniform(0.4, 0.6, len(bends)), *rng.uniform(0.35, 0.65, unknowns)])
    truth = truth[:unknowns]
    A = matrix[nodes].reshape(size, unknowns)
    y = A @ truth + SD * rng.normal(size=size)
    best, left, *_ = np.linalg.lstsq(A, y, rcond=None)
    misfit = float(left[0]) if len(left) else 0.0
    log_evidence = (
        -0.5 * misfit / SD**2 - size * np.log(SD) - 0.5 * (size - unknowns) * np.log(2.0 * np.pi)
    )
    log_evidence -= 0.5 * np.linalg.slogdet(A.T @ A / SD**2)[1]
    # The determinants of all pieces add up to the range: sum of widths is 1.
    shares = np.ones(1)
    for k, bend in enumerate(bends):
        shares = np.outer(shares, bend.preimages(best[k])[1]).ravel()
    model = cal.model(forward, cal.nodal_displacements(scene, nodes), cal.GaussianNoise(sd=SD))
    name = (
        f"{np.prod(counts)} modes, {unknowns} unknowns, steep {steep}, width {width}, seed {seed}"
    )
    return Modes(name, model, y.reshape(NODES, 3), forward, tuple(bends), log_evidence, shares)


def problems(count: int, seed: int):
    """Yield problems of all kinds in turn."""
    rng = np.random.default_rng([11, seed])
    for k in range(count):
        counts = COUNTS[k % len(COUNTS)]
        unknowns = int(rng.integers(max(2, len(counts)), 9))
        steep = (
            float(rng.choice(STEEPNESS)) if np.prod(counts) <= 8 else float(rng.choice([1.0, 1.5]))
        )
        yield problem(unknowns, counts, steep, float(rng.choice(WIDTHS)), int(rng.integers(100)))


def judge(posed: Modes, seed: int, certify: bool = False) -> dict:
    """Sample a problem and compare shares and evidence with the exact ones."""
    begin = perf_counter()
    posterior = cal.sample(posed.model, posed.data, seed=seed, predictions=False)
    seconds = perf_counter() - begin
    names = [f"stiffness_{k}" for k in range(posed.model.forward.scene.centre.size)]
    unit = np.stack([posterior.draws()[name] for name in names], axis=1) - 1.0
    shares = np.bincount(posed.of(unit), minlength=len(posed.shares)) / len(unit)
    counted = posed.shares >= 0.02
    off = float(np.max(np.abs(shares / posed.shares - 1.0)[counted]))
    attributes, told = posterior.tree.attrs, posterior.warnings()
    z = np.nan
    if "log_evidence" in attributes:
        z = (attributes["log_evidence"] - posed.log_evidence) / attributes["log_evidence_error"]
    found = {
        "name": posed.name,
        "off": off,
        "lost": int((shares < 0.1 * posed.shares).sum()),
        "wrong": off > 0.4,
        "warned": bool(told),
        "z": float(z),
        "error": float(attributes.get("log_evidence_error", np.nan)),
        "by": attributes["sampled_by"],
        "why": attributes.get("not_by_importance", ""),
        "seconds": seconds,
        "evaluations": attributes.get("evaluations"),
        "k": attributes.get("weights_pareto_k"),
        "told": [sentence[:90] for sentence in told],
    }
    if certify and found["wrong"]:
        check = cal.certify(posterior, ExactSimulator(posed.forward), seed=seed)
        found["verdict"] = check.verdict
    return found


def main() -> None:
    """Run the problems, a line each, and count."""
    warnings.filterwarnings("ignore")
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("--problems", type=int, default=60)
    words.add_argument("--seed", type=int, default=0)
    words.add_argument("--certify", action="store_true")
    asked = words.parse_args()
    rows = []
    for k, posed in enumerate(problems(asked.problems, asked.seed)):
        row = judge(posed, k, asked.certify)
        rows.append(row)
        state = "WRONG" if row["wrong"] else "right"
        state += " warned" if row["warned"] else " SILENT" if row["wrong"] else ""
        print(
            f"{row['name']}: {state}, off {row['off']:.2f}, lost {row['lost']}, {row['by']}, "
            f"k {row['k'] or np.nan:.2f}, evidence z {row['z']:.1f} (error {row['error']:.3f}), "
            f"{row['seconds']:.1f} s, {row['evaluations']} | {'; '.join(row['told'])} {row['why']} "
            f"{row.get('verdict', '')}",
            flush=True,
        )
    unwarned = [row for row in rows if not row["warned"]]
    known = [row for row in unwarned if np.isfinite(row["z"])]
    print(
        f"problems {len(rows)}: silent and wrong {sum(r['wrong'] for r in unwarned)}, "
        f"right without a warning {sum(not r['wrong'] for r in unwarned)}, right with one "
        f"{sum(not r['wrong'] and r['warned'] for r in rows)}, wrong with one "
        f"{sum(r['wrong'] and r['warned'] for r in rows)}; evidence inside 1.64 errors "
        f"{sum(abs(r['z']) < 1.645 for r in known)} of {len(known)}, two "
        f"{sum(abs(r['z']) < 2 for r in known)}; {sum(r['seconds'] for r in rows):.0f} s"
    )


if __name__ == "__main__":
    main()
