"""The tail of the weights of FEM's runs."""

import numpy as np

from calibrate.certificate.estimates import _k_hat


def test_a_tail_that_is_one_point_drawn_again_has_no_shape_and_no_traceback():
    log_weights = np.concatenate([np.linspace(-900.0, -300.0, 60), np.zeros(40)])
    assert _k_hat(log_weights) == np.inf


def test_equal_weights_have_no_tail():
    assert _k_hat(np.zeros(50)) == 0.0


def test_the_shape_of_pareto_weights_is_found():
    log_weights = -0.5 * np.log(np.random.default_rng(0).uniform(size=20_000))
    assert abs(_k_hat(log_weights) - 0.5) < 0.1
