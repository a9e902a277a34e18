"""How to train: what an emulator is made of, from how many FEM runs, by which optimiser."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, get_args

from emulator.core.errors import InputError, check_seed, look_up

Objective = Literal["energy", "simulations", "gradients", "both", "modes"]
OBJECTIVES: tuple[Objective, ...] = get_args(Objective)


@dataclass(frozen=True)
class Plan:
    """How to train. Settings that change nothing under a plan are :attr:`idle`.

    recipe : the name in :data:`RECIPES` it came from, for the record.
    seed : of the weights, the FEM runs' theta, and the batches.
    simulations : FEM runs to train the network on (not used by ``energy``) and to fit the
        discrepancy model to; after sweeps, theta at which the network is taught their polynomial.
    sweeps : over the box, which replace all FEM runs (:mod:`~emulator.training.sweeps`); with an
        ``order`` they begin at the series about the centre, FEM's one solution. Without steps their
        polynomial is the emulator.
    campaign : digest of the campaign whose first ``simulations`` rows are the FEM runs; empty where
        training makes them.
    centred : add the network to a Taylor series about the centre of the box, not to zero.
    order : of that series; 0 is the FEM solution at the centre alone.
    discrepancy : fit a discrepancy model to the FEM runs and their sensitivities.
    steps : of the network's optimiser; without any, which a discrepancy model allows, there is no
        network, and all that follows is idle.
    objective : of the network: ``energy`` (no FEM run but the centre), ``simulations``,
        ``gradients`` (simulations and their deformation gradients), ``both`` (simulations and
        energy), or ``modes`` (simulations, their deformation gradients and slopes in theta, all at
        every step: :mod:`~emulator.training.modal`).
    batch : theta a step.
    learning_rate : of the optimiser, Adam or (for ``modes``) Muon, at its peak.
    schedule : ``cosine`` to zero after a warm-up, or ``halves``: the peak, then a tenth of it.
    energy_weight : weight of the energy gap in ``both``.
    decoder : ``pointwise`` or ``separable``.
    modes : mechanical modes given to a separable decoder, at most.
    freeze : step after which a separable decoder keeps its modes and trains its branch alone.
    polish : iterations of L-BFGS on the branch after the steps, for ``modes``.
    checkpoint_every : steps between checkpoints.
    """

    recipe: str = "network"
    objective: Objective = "both"
    steps: int = 3000
    simulations: int = 256
    sweeps: int = 0
    batch: int = 16
    learning_rate: float = 1e-3
    schedule: Literal["cosine", "halves"] = "cosine"
    energy_weight: float = 0.3
    centred: bool = True
    order: int = 0
    decoder: Literal["pointwise", "separable"] = "pointwise"
    modes: int = 40
    freeze: int = 200
    polish: int = 0
    discrepancy: bool = False
    checkpoint_every: int = 500
    seed: int = 0
    campaign: str = ""

    def __post_init__(self) -> None:
        if self.objective not in OBJECTIVES:
            *others, last = OBJECTIVES
            raise InputError(f"objective '{self.objective}': use {', '.join(others)} or {last}")
        check_seed(self.seed, "training")
        for fault in self._faults():
            raise InputError(f"training: {fault}")

    def _faults(self) -> Iterator[str]:
        """What cannot work."""
        trains = not (self.discrepancy or self.as_learned or self.sweeps)
        for name, least in {"steps": int(trains), "batch": 1, "checkpoint_every": 1}.items():
            if getattr(self, name) < least:
                yield f"{name} is {getattr(self, name)}; it must be {least} or more"
        if not 0.0 < self.learning_rate < math.inf:
            yield f"learning_rate is {self.learning_rate}; it must be positive and finite"
        if self.sweeps < 0:
            yield f"{self.sweeps} sweeps; give 16 or more"
        if self.sweeps and (self.discrepancy or self._by_batches):
            yield f"recipe '{self.recipe}' takes FEM runs, not sweeps; use recipe physics or sweeps"
        if self.simulations < (1 if self.discrepancy else 0):
            yield f"{self.simulations} simulations; a discrepancy model needs 1 or more"
        if self.objective == "modes" and self.simulations < 1:
            yield f"{self.simulations} simulations; modes need 1 or more"
        if self.objective not in ("energy", "modes") and self.simulations < self.batch:
            yield f"{self.simulations} simulations are fewer than a batch of {self.batch}"
        if not 0 <= self.order <= 4 or (self.order and not self.centred):
            about = "" if self.centred else " without a centre"
            yield f"a series of order {self.order}{about}; give 0 to 4, 0 without a centre"
        alone = self.decoder == "separable" and self.centred and not self.order
        if self.objective == "modes" and (not alone or self.discrepancy or self.modes):
            yield (
                f"recipe '{self.recipe}' cannot have the objective 'modes', which is for "
                "a separable network alone about the centre's solution; use recipe modal"
            )

    @property
    def as_learned(self) -> bool:
        """Whether a network is taken as another emulator has it: nothing is trained or fitted."""
        return not self.steps and self.recipe == "family"

    @property
    def on_coarse(self) -> bool:
        """Whether an emulator on a coarser mesh is what the discrepancy model stands on."""
        return self.recipe == "two_meshes"

    @property
    def idle(self) -> dict[str, str]:
        """Settings that change nothing, and why."""
        found = {}
        if not self.steps:
            found = dict.fromkeys(("objective", "batch"), "trains no network")
        elif self.objective == "modes":
            found = {"batch": "takes all FEM runs at every step"}
        if not self.sweeps:
            found["sweeps"] = "makes none"
        if not (self.runs or (self.sweeps and self.steps)):
            found["simulations"] = "takes no FEM runs"
        if self.as_learned:
            found["seed"] = "draws nothing at random"
        return found

    @property
    def _by_batches(self) -> bool:
        """Whether a network is trained on a few theta a step."""
        return bool(self.steps) and self.objective != "modes"

    @property
    def slopes(self) -> bool:
        """Whether the FEM runs' derivatives in theta are wanted."""
        return self.discrepancy or self.objective == "modes"

    @property
    def runs(self) -> int:
        """FEM runs besides the centre's; none, not even that one, after sweeps."""
        if self.sweeps:
            return 0
        return self.simulations if self.discrepancy or self.objective != "energy" else 0


RECIPES: dict[str, Plan] = {
    "hybrid": Plan(
        recipe="hybrid",
        objective="energy",
        order=3,
        decoder="separable",
        discrepancy=True,
        simulations=200,
        steps=2000,
    ),
    "mechanics": Plan(
        recipe="mechanics",
        objective="energy",
        order=3,
        decoder="separable",
        discrepancy=True,
        simulations=60,
        steps=0,
    ),
    "two_meshes": Plan(
        recipe="two_meshes", objective="energy", discrepancy=True, simulations=10, steps=0
    ),
    "family": Plan(recipe="family", objective="energy", steps=0),
    "network": Plan(),
    "modal": Plan(
        recipe="modal",
        objective="modes",
        decoder="separable",
        modes=0,
        simulations=400,
        learning_rate=2e-3,
        steps=20_000,
        freeze=2000,
        polish=4000,
    ),
    "physics": Plan(
        recipe="physics",
        objective="modes",
        decoder="separable",
        modes=0,
        sweeps=60,
        simulations=400,
        learning_rate=2e-3,
        steps=20_000,
        freeze=2000,
        polish=4000,
    ),
    "sweeps": Plan(recipe="sweeps", objective="energy", sweeps=60, steps=0),
    "paper": Plan(
        recipe="paper",
        objective="energy",
        centred=False,
        batch=1,
        learning_rate=1e-4,
        schedule="halves",
        steps=100_000,
    ),
}
"""``hybrid``: a Taylor series, a network trained on the energy in mechanical modes, and a
discrepancy model. ``mechanics``: the same without a network, from a mesh to an emulator in a
minute. ``two_meshes``: an emulator on a coarser mesh of the same body, and a discrepancy model of
a few runs on the scene's own. ``family``: a network that has learned a family of bodies, on this
one, without any FEM run. ``modal``: a network alone about the FEM solution at the centre, its modes
by variable projection, their coefficients from values and slopes of FEM runs. ``physics``: the same
without any FEM run: what it is taught comes of sweeps over the box, which minimise the energy.
``sweeps``: their polynomial, without a network. ``network``:
Algorithm 1 about the FEM solution at the centre, trained on FEM runs and the energy. ``paper``:
Algorithm 1 from zero, the energy at one theta a step, Adam at 1e-4 and then 1e-5, as released by
Dalton et al. (2023)."""


def recipe(name: str) -> Plan:
    """The plan of that name; :class:`InputError` lists the names."""
    return look_up(RECIPES, name, "recipe")
