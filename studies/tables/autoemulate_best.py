"""AutoEmulate's best model of a table by its own choice, run by an interpreter that has it:

    PYTHON autoemulate_best.py problem.npz predictions.npz

Each model is compared as AutoEmulate compares, by rows that it keeps apart itself, untuned and,
while there is time, tuned; the best of all is fitted to every row and predicts rows that nobody
has shown it.
"""

import signal
import sys
import warnings
from importlib.metadata import version
from time import monotonic

import numpy as np
import torch
from autoemulate import AutoEmulate

UNTUNED = (
    "GaussianProcessRBF",
    "GaussianProcessMatern32",
    "GaussianProcessCorrelatedRBF",
    "GaussianProcessCorrelatedMatern32",
    "RadialBasisFunctions",
    "PolynomialRegression",
    "MLP",
    "EnsembleMLP",
    "RandomForest",
)
TUNED = ("RadialBasisFunctions", "GaussianProcessRBF", "GaussianProcessMatern32", "EnsembleMLP")
TRIALS, SPLITS = 8, 2  # of a model's tuning
SEED = 0


class OutOfTime(BaseException):
    """A model took longer than what was left; no Exception, which AutoEmulate would catch."""


def expired(*_: object) -> None:
    raise OutOfTime


def best_of(model: str, x: np.ndarray, y: np.ndarray, seconds: float, **options: object):
    """A model's R2 on rows that AutoEmulate keeps apart, and the model fitted to all rows."""
    signal.setitimer(signal.ITIMER_REAL, max(seconds, 1e-3))
    try:
        compared = AutoEmulate(
            x, y, models=[model], random_seed=SEED, show_progress_bar=False, device="cpu",
            n_bootstraps=None, **options,
        )  # fmt: skip
        metrics = compared.best_result().test_metrics
        score = next(values[0] for metric, values in metrics.items() if metric.name == "r2")
        return float(score), compared.fit_from_reinitialized(x, y, random_seed=SEED)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)


def main() -> None:
    warnings.filterwarnings("ignore")
    signal.signal(signal.SIGALRM, expired)
    problem = np.load(sys.argv[1], allow_pickle=False)
    x, y, apart = problem["x"], problem["y"], problem["apart"]
    limit, begin = float(problem["seconds"]), monotonic()
    tries: list[tuple[str, str, dict[str, object]]]
    tries = [(model, "untuned", {"model_params": {}}) for model in UNTUNED]
    tries += [(model, "tuned", {"n_iter": TRIALS, "n_splits": SPLITS}) for model in TUNED]
    scores, names, best = [], [], None
    for model, how, options in tries:
        try:
            score, fitted = best_of(model, x, y, limit - (monotonic() - begin), **options)
        except (
            Exception,
            OutOfTime,
        ) as error:  # one model that fails is no reason to leave out the others
            print(f"{model}, {how}: {type(error).__name__}: {error}", file=sys.stderr)
            continue
        scores.append(score)
        names.append(f"{model}, {how}")
        if score == max(scores):
            best = fitted
    answer = best.predict(torch.tensor(apart, dtype=torch.float32))
    mean = answer if torch.is_tensor(answer) else answer.mean
    np.savez(
        sys.argv[2],
        predicted=mean.detach().double().numpy().reshape(len(apart), -1),
        best=names[int(np.argmax(scores))],
        models=np.array(names),
        scores=np.array(scores),
        seconds=monotonic() - begin,
        version=version("autoemulate"),
    )


if __name__ == "__main__":
    main()
