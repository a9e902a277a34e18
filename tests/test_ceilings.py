"""What grows unseen stays under its ceiling (``python -m tests.ceilings`` shows what is counted)."""

import pytest

from ceilings import FIGURES


@pytest.mark.parametrize("figure", FIGURES)
def test_a_figure_is_under_its_ceiling(figure):
    ceiling, count = FIGURES[figure]
    items = count()
    assert len(items) <= ceiling, "\n".join(items)
