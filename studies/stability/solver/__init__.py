"""Hard cases for the simulator, one family a module."""

from studies.stability.solver import boxes as boxes
from studies.stability.solver import buckling as buckling
from studies.stability.solver import exponentials as exponentials
from studies.stability.solver import follower as follower
from studies.stability.solver import incompressible as incompressible
from studies.stability.solver import meshes as meshes
from studies.stability.solver import starts as starts
from studies.stability.solver import stiffness as stiffness
from studies.stability.solver import supports as supports
from studies.stability.solver import theta as theta
from studies.stability.solver import twists as twists
from studies.stability.solver import ventricles as ventricles
from studies.stability.solver.case import CASES

__all__ = ["CASES"]
