"""Input decks of FEBio, of Abaqus and CalculiX, and of svMultiPhysics as scene files.

:mod:`.deck` is what any deck says, :mod:`.materials` the equations between parameters there and
here. :mod:`.febio`, :mod:`.abaqus` and :mod:`.svmultiphysics` read one format each, the two of XML
by :mod:`.tags`, and :mod:`.draft` writes the mesh and the scene file. What a reader does not
understand it lists, with its line. A law, a load or an element that this package does not have is
refused.
"""
