"""Footwork: a four-legged ant learns to walk, and then to find its way.

Four sub-policies learn one direction each, a master learns which of them to run
next, and regularisers make the hand-over between them safe. Importing this package
imports nothing heavy: the tasks are in :mod:`footwork.tasks`, the engines in
:mod:`footwork.physics`, the learner in :mod:`footwork.learn`, the experiments in
:mod:`footwork.study`, and the command line in :mod:`footwork.doors`.
"""

__version__ = "0.1.0"
