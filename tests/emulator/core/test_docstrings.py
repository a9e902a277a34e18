"""What is read of docstrings."""

from emulator.core.schema import documented, summary


class Ball:
    """A ball of :class:`~numpy.ndarray`, which
    rolls.

    Longer words: none of them an entry.

    Parameters
    ----------
    radius, height : of the ball and of where
        it lies, ``mm``.
    colour : as painted.

    Raises
    ------
    ValueError
        It is no ball.
    """


class Football(Ball):
    """A ball to kick.

    colour : of its club.
    panels : by default 32.

    More on panels.
    """


def test_summary_is_one_line_without_markup():
    assert summary(Ball) == "A ball of numpy.ndarray, which rolls."


def test_entries_are_read_with_and_without_a_heading_and_from_bases():
    size = "of the ball and of where it lies, mm."
    assert documented(Ball) == {"radius": size, "height": size, "colour": "as painted."}
    assert documented(Football) == {
        "radius": size,
        "height": size,
        "colour": "of its club.",
        "panels": "by default 32.",
    }
