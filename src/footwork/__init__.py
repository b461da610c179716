"""Footwork: a four-legged ant learns to walk, and then to find its way.

Four sub-policies learn one direction each, a master learns which of them to run
next, and regularisers make the hand-over between them safe. Importing this package
imports nothing heavy: the tasks are in :mod:`footwork.tasks`, the engines in
:mod:`footwork.physics`, the learner in :mod:`footwork.learn`, the experiments in
:mod:`footwork.study`, and the command line and the Gymnasium environments in
:mod:`footwork.doors`.

``import footwork`` makes the environments known to Gymnasium, before or after
``import gymnasium``, which this package itself never causes: it has it registered
when, and only if, somebody imports it.
"""

import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import sys
import warnings
from collections.abc import Sequence
from types import ModuleType

__version__ = "0.1.0"


class _AfterGymnasium(importlib.abc.MetaPathFinder):
    """Finds nothing itself; has the environments registered once Gymnasium has been imported, and is gone.

    Gymnasium 1.4 has no entry points. Importing it here would cost every command 0.2 s, and
    registering only if it has been imported already would hang on the order of two imports.
    """

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if fullname != "gymnasium":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(fullname)
        if spec is not None and spec.loader is not None:
            run = spec.loader.exec_module

            def run_and_register(module: ModuleType) -> None:
                run(module)
                _register()

            spec.loader.exec_module = run_and_register  # type: ignore[method-assign]
        return spec


def _register() -> None:
    try:
        importlib.import_module("footwork.doors.gym")
    except ImportError as error:  # a Gymnasium too old for us must stay usable for others
        warnings.warn(f"the environments of Footwork are not registered: {error}", stacklevel=2)


if "gymnasium" in sys.modules:
    _register()
else:
    sys.meta_path.insert(0, _AfterGymnasium())
