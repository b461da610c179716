"""The commands of ``footwork``, by room. Each is its options, and ``run``, which imports what it needs.

Importing a room costs next to nothing: ``footwork --help`` reads them all.
"""
