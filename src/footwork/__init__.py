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
import sys
import warnings
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType

__version__ = "0.1.0"


class _AfterGymnasium:
    """A finder that finds nothing of its own: it has the environments registered once Gymnasium has been imported.

    Why a hook, and not one of the plainer ways? Gymnasium 1 has no entry points for environments. Importing it here
    would cost every command 0.2 s, ``footwork --help`` half of its time. Registering only where it has been imported
    already would hang on the order of two imports, which linters sort. And an import of our own that users must
    write (``import footwork.doors.gym``) is not "registered on import". The hook costs nothing until it is needed.
    """

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != "gymnasium":
            return None
        others = (finder for finder in sys.meta_path if finder is not self)
        spec = next((found for finder in others if (found := finder.find_spec(fullname, path, target))), None)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def execute_and_register(module: ModuleType) -> None:
                execute(module)
                if self in sys.meta_path:  # here and not above: whoever only asks for a spec has not imported it
                    sys.meta_path.remove(self)
                _register()

            spec.loader.exec_module = execute_and_register  # type: ignore[method-assign]
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
