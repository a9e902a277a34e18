"""The commands, one a file.

A command is a module of this package with ``register(commands)``, which adds its parser, and
``run(arguments) -> exit code``. Every module of this package is found automatically. Packages that
take long to import are imported inside ``run``, so that ``--help`` is quick.
"""
