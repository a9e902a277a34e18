"""The commands, one a file.

A command is a module of this package with ``register(commands)``, which adds its parser and sets
``run(arguments) -> exit code``. Every module here is found by itself. Whatever takes long to import
is imported by ``run``, so that ``--help`` is quick.
"""
