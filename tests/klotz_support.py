"""A forward map whose cavity follows Klotz's curve, or leaves it as theta says."""

from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist

import calibrate as cal
from emulator.scenes.scene import all_nodes
from emulator.surrogates.protocol import Prediction

VOLUME, PRESSURE = 120.0, 1.3  # mL, kPa
PRIOR = {"a": dist.Uniform(0.1, 20.0), "b": dist.Uniform(0.5, 2.0)}


@dataclass(frozen=True, eq=False)
class Lengthening:
    """Lengthens below its base until the cavity has the volume that is wanted.

    That is Klotz's through 120 + a mL at 1.3 kPa, at 1.3 kPa times the b-th power of what share of
    it the pressure is: with b = 1 the curve is Klotz's.
    """

    scene: object
    nodes: np.ndarray
    kind = label = fingerprint = "lengthening"

    def at(self, nodes):
        return replace(self, nodes=nodes)

    def __call__(self, theta):
        a, b, pressure = theta[0], theta[1], theta[-1]
        wanted = cal.Klotz(VOLUME + a, PRESSURE).volume(PRESSURE * (pressure / PRESSURE) ** b)
        stretch = wanted / cal.CavityVolume(self.scene).cavity.rest
        z = self.scene.mesh.nodes[:, 2]
        along = jnp.asarray(z - z.max())[self.nodes] * (stretch - 1.0)
        return jnp.zeros((len(self.nodes), 3)).at[:, 2].set(along)

    def evaluate(self, theta):
        return Prediction(self(theta), jnp.array(True))


def lengthening(scene):
    return Lengthening(scene, all_nodes(scene))


def model_of(forward, prior, sds=None, **known):
    """Volume, or what ``sds`` names, with a_f and b_f known, which the map does not read."""
    sds = sds or {"volume": 1.0}
    seen = {
        "volume": cal.CavityVolume(forward.scene),
        f"klotz:{PRESSURE}": cal.KlotzVolume(forward.scene, PRESSURE),
    }
    parts = {name: seen[name.split("@")[0]] for name in sds}
    noise = {name: cal.GaussianNoise(sd=sd) for name, sd in sds.items()}
    return cal.model(forward, parts, noise, prior, known={"a_f": 5.0, "b_f": 1.7, **known})
