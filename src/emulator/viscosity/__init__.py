r"""Viscosity of any law: finite linear viscoelasticity (Simo 1987; Holzapfel and Simo 1996).

A law's energy W is that of an instant change of shape. Its isochoric part, fibres included, is W at
the deformation without its change of volume, and relaxes; the volumetric rest does not,

.. math::
    W = W_\text{vol} + W_\text{iso}, \quad W_\text{iso}(C) = W(J^{-2/3} C), \qquad
    S = S_\text{vol} + g_\infty S_\text{iso} + \sum_a Q_a, \quad
    \dot Q_a + Q_a / \tau_a = g_a \dot S_\text{iso}, \quad g_\infty = 1 - \sum_a g_a .

S and the overstresses :math:`Q_a` are second Piola-Kirchhoff stresses, which no rotation of the
body changes, so the model is objective. :math:`S_\text{iso} : C = 0`, and a change of volume is
elastic: a specimen that keeps its volume is the limit of a large bulk modulus. Equations are those
of Holzapfel, *Nonlinear Solid Mechanics* (2000), Section 6.10, with fractions :math:`g_a` of the
instantaneous stress, as in Simo's article, in place of multiples of the relaxed one: then any
:math:`g_\infty > 0` is stable, and fractions have bounds. **Moduli of the law are instantaneous.**
The moduli of equilibrium, after a long time, are :math:`g_\infty` times as large. The energy of
a specimen is W for an infinite rate, and for rate zero
:math:`W_\text{vol} + g_\infty W_\text{iso}`.

Over a time step in which :math:`S_\text{iso}` goes linearly from the old to the new value the
solution is exact (Taylor, Pister and Goudreau 1970), for every step stable, and of second order
otherwise: with :math:`x_a = \Delta t / \tau_a` and :math:`\gamma_a = (1 - e^{-x_a}) / x_a`

.. math:: Q_a = e^{-x_a} Q_a^\text{old} + \gamma_a g_a (S_\text{iso} - S_\text{iso}^\text{old}) .

The stress of a step is therefore that of a hyperelastic law, with potential

.. math::
    W_\text{vol} + s W_\text{iso} + A : E, \qquad s = g_\infty + \sum_a \gamma_a g_a, \quad
    A = \sum_a \left(e^{-x_a} Q_a^\text{old} - \gamma_a g_a S_\text{iso}^\text{old}\right),

which equilibrium in free directions minimises, as it does without viscosity.

:mod:`~emulator.viscosity.series` has the fractions and times, :mod:`~emulator.viscosity.overstress`
the step, :mod:`~emulator.viscosity.times` the times of a table, and
:mod:`~emulator.fem.through_time` the steps of a body.
"""
