"""Forward maps and simplified scenes, judged by FEM."""

from calibrate.evaluation.evaluation import Evaluated, Evaluation, run_evaluation

__all__ = ["Evaluated", "Evaluation", "run_evaluation"]
