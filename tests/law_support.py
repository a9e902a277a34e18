"""Parameters of every built-in law, and directions, that several test modules use."""

import jax.numpy as jnp
import numpy as np

MU, LAM = 3.0, 7.0
ARGUMENTS = {
    "neo_hookean": (MU, LAM),
    "neo_hookean_E_nu": (8.0, 0.3),
    "neo_hookean_split": (3.0, 40.0),
    "holzapfel_ogden": (0.3, 2.0, 3.0, 2.5, 25.0),
    "small_strain": (MU, LAM),
    "small_strain_E_nu": (8.0, 0.3),
    "holzapfel_ogden_unswitched": (0.3, 2.0, 3.0, 2.5, 25.0),
    "holzapfel_ogden_isotropic": (3.0, 2.0, 25.0),
    "holzapfel_ogden_dispersed": (0.3, 2.0, 3.0, 2.5, 0.1, 25.0),
    "holzapfel_ogden_dispersed_unswitched": (0.3, 2.0, 3.0, 2.5, 0.1, 25.0),
    "holzapfel_ogden_released": (0.15, 2.0, 1.5, 2.5, 25.0),
    "holzapfel_ogden_orthotropic": (0.3, 2.0, 3.0, 2.5, 2.0, 1.5, 0.8, 3.0, 25.0),
    "guccione": (2.0, 8.0, 2.0, 4.0, 50.0),
    "mooney_rivlin": (2.0, 1.0, 40.0),
    "yeoh": (2.0, 0.5, 0.3, 40.0),
    "ogden_1": (3.0, 5.0, 40.0),
    "ogden_2": (3.0, 5.0, 1.0, -2.0, 40.0),
    "ogden_3": (2.0, 1.5, 1.0, -3.0, 0.5, 8.0, 40.0),
    "fung_planar": (2.0, 8.0, 4.0, 2.0, 3.0, 1.0, 50.0),
    "fung_orthotropic": (2.0, 8.0, 4.0, 3.0, 2.0, 1.0, 1.5, 3.0, 2.0, 2.5, 1.0, 50.0),
    "holzapfel_gasser_ogden": (3.0, 2.0, 2.5, 40.0, 25.0),
    "gasser_ogden_holzapfel": (3.0, 2.0, 2.5, 40.0, 0.1, 25.0),
    "may_newman": (0.5, 2.0, 8.0, 1.0, 25.0),
    "invariant_terms": (1.0, 2.0, 0.5, 1.5, 2.5, 3.0, 4.0, 0.7, 3.5, 0.6, 2.2, 0.4, 25.0),
}
FIBRE = np.array([2.0, -1.0, 2.0]) / 3.0
SHEET = np.array([2.0, 2.0, -1.0]) / 3.0


def directions(law):
    """What ``law`` asks for, as a strain takes it."""
    if law.sheets:
        return jnp.asarray(np.stack([FIBRE, SHEET]))
    return jnp.asarray(FIBRE) if law.fibres else None
