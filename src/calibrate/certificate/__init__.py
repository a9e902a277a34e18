"""Certificates: whether a posterior made with a cheap forward map agrees with FEM's.

:func:`certify` gives the verdict, :func:`reweight` FEM's posterior where the draws are not it. Both
rest on :func:`examine`, which solves FEM a fixed number of times.
"""

from calibrate.certificate.check import Check, certify, examine
from calibrate.certificate.reweighting import reweight
from calibrate.certificate.verdict import Certificate, Verdict, judge

__all__ = ["Certificate", "Check", "Verdict", "certify", "examine", "judge", "reweight"]
