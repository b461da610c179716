"""The command line: ``footwork --help`` lists the commands, which are in :mod:`footwork.doors.commands`.

Only what a command needs is imported, and only once it is known which command it is:
``footwork --help`` answers at once.
"""

from __future__ import annotations

import hashlib
import os
import platform
import re
import sys
import warnings
from pathlib import Path
from typing import Any, TextIO

import tyro

from footwork.doors.commands.comparing import Parity
from footwork.doors.commands.running import Evaluate, Export, List, Quickstart, Train, Transitions
from footwork.doors.commands.seeing import Play, Replay, Video
from footwork.doors.commands.studying import Bench, Figures, Report, Reproduce

# In the order of ``footwork --help``.
Command = (
    List
    | Train
    | Evaluate
    | Transitions
    | Quickstart
    | Export
    | Replay
    | Video
    | Play
    | Bench
    | Reproduce
    | Figures
    | Report
    | Parity
)


def main() -> None:
    """The entry point."""
    keep_compiled()
    leave_accelerators(sys.argv[1:])
    warnings.showwarning = show_warning
    sys.exit(run(sys.argv[1:]))


def show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """Say in one line what Footwork warns of; where in a source it came up, only of what others do."""
    ours = category is UserWarning and Path(filename).is_relative_to(Path(__file__).parents[1])
    text = f"footwork: {message}\n" if ours else None
    stream = sys.stderr if file is None else file
    stream.write(text or warnings.formatwarning(message, category, filename, lineno, line))


def keep_compiled() -> None:
    """Have JAX keep its compiled programs, so that only the first start of a kind has to wait for them.

    They lie in the user's cache directory, for each kind of processor apart: they are machine
    code. ``FOOTWORK_CACHE`` names another place, or is empty to keep nothing; JAX's own
    variables go before. JAX is told by its environment, so that nothing is imported here.
    """
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    place = os.environ.get("FOOTWORK_CACHE", str(Path(base, "footwork")))
    if place:
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(place, f"jax-{_processor()}")))
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")


def leave_accelerators(arguments: list[str]) -> None:
    """Have JAX compute on the CPU, on a machine with a GPU too, unless the command names the engine that runs there.

    The other engines step ants from the host, many small calls a step: a GPU between them would slow all of it, and be
    taken from others. An address, a folder or ``--engine`` may name it; ``JAX_PLATFORMS``, JAX's own variable, goes
    before.
    """
    if not any("mjx" in re.split("[/=]", argument) for argument in arguments):
        os.environ.setdefault("JAX_PLATFORMS", "cpu")


def _processor() -> str:
    """A name for what this processor can execute."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        abilities = next(line for line in lines if line.startswith(("flags", "Features")))
    except (OSError, StopIteration):
        abilities = platform.processor()
    return f"{platform.machine()}-{hashlib.sha256(abilities.encode()).hexdigest()[:12]}"


def run(arguments: list[str]) -> int:
    """Run one command; what a user can mend is one line on stderr and exit status 1, 130 for an interrupt."""
    commands: Any = Command
    command, rest = tyro.cli(commands, args=arguments, prog="footwork", return_unknown_args=True)
    if rest and not isinstance(command, Train):
        print(f"footwork: unknown options: {' '.join(rest)}; see footwork {arguments[0]} --help", file=sys.stderr)
        return 2
    try:
        return command.run(rest) if isinstance(command, Train) else command.run()
    except KeyboardInterrupt:
        print("footwork: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        sys.stderr.close()
        return 0
    except Exception as error:
        if _device_is_missing(error):
            platforms = os.environ["JAX_PLATFORMS"]
            print(f"footwork: JAX_PLATFORMS is {platforms!r}: JAX finds no such device here; unset it", file=sys.stderr)
            return 1
        if not _is_for_the_user(error):
            raise
        print(f"footwork: {error}", file=sys.stderr)
        return 130 if type(error).__name__ in ("Interrupted", "SweepStopped") else 1


def _is_for_the_user(error: Exception) -> bool:
    from footwork.train import Interrupted, TrainingDiverged

    stopped = isinstance(error, Interrupted | TrainingDiverged) or type(error).__name__ == "SweepStopped"
    return stopped or isinstance(error, ValueError | OSError | ImportError)


def _device_is_missing(error: Exception) -> bool:
    """Whether JAX failed for want of the device that ``JAX_PLATFORMS`` asks for: asked again, it fails again."""
    if not (os.environ.get("JAX_PLATFORMS") and isinstance(error, AssertionError | RuntimeError)):
        return False
    import jax

    try:
        jax.devices()
    except (AssertionError, RuntimeError):  # the first where JAX was built without it
        return True
    return False
