"""External problems: somebody else's solver, or a table of its runs, in place of a scene.

Modules say what it is asked (:mod:`.problem`), how it is asked (:mod:`.command`, :mod:`.function`,
:mod:`.bridge`, :mod:`.rows`), its file (:mod:`.file`), and its forward maps (:mod:`.maps`).
"""
