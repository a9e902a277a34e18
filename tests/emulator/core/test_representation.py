"""What objects say of themselves, as text and in a notebook."""

import html

import emulator as em
from emulator.core.display import TableRepr


def test_a_scene_and_what_is_made_of_it(beam, simulator):
    count = len(beam.mesh.nodes)
    assert repr(beam).startswith(f"<Scene 'once_clamped_beam': mesh {count} nodes, ")
    assert "theta mu 50 to 100 kPa, lam 50 to 100 kPa" in repr(beam)
    assert repr(simulator).startswith("<Simulator of 'once_clamped_beam': ")
    assert f"unknowns {(~beam.held).sum()}" in repr(simulator)
    shipped = em.load("once_clamped_beam")
    assert "parts taylor" in repr(shipped)
    assert "recipe physics" in repr(shipped)
    for thing in (beam, simulator, shipped):
        table = thing._repr_html_()
        assert table.startswith("<table><caption>")
        assert len(repr(thing)) < 500


def test_html_is_text():
    class Odd(TableRepr):
        def summary_rows(self):
            return "<b>", [("a", "1 < 2")]

    assert Odd()._repr_html_().count("<b>") == 1  # the row's own
    assert html.escape("1 < 2") in Odd()._repr_html_()
