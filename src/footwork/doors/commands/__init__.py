"""The commands of ``footwork``, by room. Each is its options, and ``run``, which imports what it needs.

Importing a room costs next to nothing: ``footwork --help`` reads them all.
"""

import sys


def say(line: str) -> None:
    """Tell whoever looks on; what a command prints for others to read stays apart from it."""
    print(line, file=sys.stderr, flush=True)
