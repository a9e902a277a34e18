"""Forward maps and simplified scenes, judged by FEM."""

from calibrate.analysis.evaluation.evaluation import Evaluated, Evaluation, run_evaluation

__all__ = ["Evaluated", "Evaluation", "run_evaluation"]
