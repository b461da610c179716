"""What a run leaves on disk, and what it says while it goes.

A run directory::

    config.json            what was asked for, and the versions that did it
    metrics.jsonl          one JSON object per line, each with its "step"
    checkpoints/           step_XXXXXXXXXX.safetensors, the newest two
    policy.safetensors     the final parameters
    tensorboard/           event files, with the extra footwork[tb]
    DONE                   the summary, written last: the run is finished
    lock                   held by the live process that uses the directory

Order is what makes a resumed run equal to one that never stopped: the metrics up to a
step are written before the checkpoint of that step, and resuming from a checkpoint
first calls :meth:`RunDir.rewind` to forget what came after it.

JSON has no word for numbers that are not finite: in metrics and in configs they are
the strings "nan", "inf" and "-inf", which :func:`read_metrics` and
:func:`config_from_json` turn back into floats.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import functools
import hashlib
import importlib.metadata
import io
import json
import math
import os
import platform
import re
import subprocess
import sys
import time
import types
import typing
import warnings
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any, Literal, NamedTuple, TextIO, TypeVar, Union

import jax
import numpy as np

import footwork
from footwork import checkpoint
from footwork.checkpoint import CheckpointError

KEEP_CHECKPOINTS = 2

_NOT_FINITE = ("nan", "inf", "-inf")
_CHECKPOINT_NAME = re.compile(r"step_(\d{10,})\.safetensors")
_Config = TypeVar("_Config")


class RunError(ValueError):
    """A run directory cannot be used as asked. One line, naming the directory or file."""


class RunInUse(RunError):
    """Another live process has the directory."""


class Latest(NamedTuple):
    """The newest checkpoint that is whole."""

    path: Path | None  # None where there is none
    step: int  # of that checkpoint; -1 where there is none
    skipped: tuple[str, ...]  # what is wrong with each newer one, newest first


@dataclass(frozen=True)
class RunDir:
    """A directory that holds one run. Make one with :meth:`create` or :meth:`open_existing`."""

    path: Path

    @classmethod
    def create(cls, path: Path, config: dict[str, Any]) -> RunDir:
        """Start a run in ``path``, which must not exist or be empty; config.json gets ``config`` and the versions.

        Raises:
            RunError: the directory holds something (a finished or unfinished run, or other files),
                is in use, or cannot be made; or ``config`` is not JSON.
            CheckpointError: config.json cannot be written.
        """
        run = cls(Path(path))
        try:
            text = json.dumps({"config": config, "versions": versions()}, indent=2, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise RunError(f"{path}: the config of a run must be JSON: {error}") from None
        try:
            run.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RunError(f"cannot make the run directory {path}: {error.strerror or error}") from error
        run._refuse_occupied()
        with run.lock():
            run._refuse_occupied()  # again: somebody may have been faster
            checkpoint.write_atomically(run.path / "config.json", text.encode() + b"\n")
        return run

    @classmethod
    def open_existing(cls, path: Path) -> RunDir:
        """The run in ``path``, finished or not.

        Raises:
            RunError: there is no run there, or its config.json cannot be read.
        """
        run = cls(Path(path))
        if not (run.path / "config.json").is_file():
            raise RunError(f"{path} is not a run directory: it has no config.json")
        run.config()
        return run

    @property
    def finished(self) -> bool:
        """Whether the run came to its end."""
        return (self.path / "DONE").is_file()

    @property
    def metrics_path(self) -> Path:
        """The file of metrics."""
        return self.path / "metrics.jsonl"

    @property
    def policy_path(self) -> Path:
        """The file of final parameters, a checkpoint as :mod:`footwork.checkpoint` writes them."""
        return self.path / "policy.safetensors"

    def config(self) -> dict[str, Any]:
        """The config the run was created with.

        Raises:
            RunError: config.json cannot be read.
        """
        config = _read_object(self.path / "config.json").get("config")
        if not isinstance(config, dict):
            raise RunError(f"{self.path / 'config.json'} is damaged: it has no config")
        return config

    def versions(self) -> dict[str, Any]:
        """The versions the run was created with, as :func:`versions` gave them.

        Raises:
            RunError: config.json cannot be read.
        """
        versions = _read_object(self.path / "config.json").get("versions", {})
        if not isinstance(versions, dict):
            raise RunError(f"{self.path / 'config.json'} is damaged: its versions are not named")
        return versions

    def summary(self) -> dict[str, Any]:
        """What :meth:`finish` was given.

        Raises:
            RunError: the run is not finished, or DONE cannot be read.
        """
        return _read_object(self.path / "DONE")

    def finish(self, summary: dict[str, Any]) -> None:
        """Write DONE; the last thing a run does.

        Raises:
            CheckpointError: DONE cannot be written.
            RunError: ``summary`` is not made of JSON values, numbers and arrays.
        """
        text = json.dumps(_jsonable(summary, "summary"), indent=2, allow_nan=False)
        checkpoint.write_atomically(self.path / "DONE", text.encode() + b"\n")

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Keep every other live process out; a killed process lets go by dying.

        Raises:
            RunInUse: another process has the directory; named by its id.
            RunError: it cannot be locked.
        """
        try:
            descriptor = os.open(self.path / "lock", os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            raise RunError(f"cannot lock run directory {self.path}: {error.strerror or error}") from error
        try:
            _take(descriptor, self.path)
            yield
            with contextlib.suppress(OSError):
                os.ftruncate(descriptor, 0)
        finally:
            os.close(descriptor)

    def checkpoints(self) -> list[tuple[int, Path]]:
        """Steps and files of all checkpoints, oldest first, sound or not."""
        directory = self.path / "checkpoints"
        files = directory.iterdir() if directory.is_dir() else ()
        named = ((_CHECKPOINT_NAME.fullmatch(file.name), file) for file in files)
        return sorted((int(match[1]), file) for match, file in named if match)

    def save_checkpoint(self, step: int, tree: Any, meta: dict[str, Any]) -> Path:
        """Save the whole state at ``step`` (``meta`` gets the step too), then drop all but the newest two.

        Raises:
            CheckpointError: it cannot be written; the earlier checkpoints are all still there.
        """
        if step < 0:
            raise ValueError(f"step must be >= 0, got {step}")
        path = self.path / "checkpoints" / f"step_{step:010d}.safetensors"
        checkpoint.save(path, tree, {**meta, "step": step})
        for _, old in self.checkpoints()[:-KEEP_CHECKPOINTS]:
            with contextlib.suppress(OSError):
                old.unlink()
        return path

    def latest_checkpoint(self) -> Latest:
        """The newest checkpoint that can be read, and why newer ones cannot."""
        skipped: list[str] = []
        for step, path in reversed(self.checkpoints()):
            try:
                checkpoint.load_arrays(path)
            except CheckpointError as error:
                skipped.append(str(error))
            else:
                return Latest(path, step, tuple(skipped))
        return Latest(None, -1, tuple(skipped))

    def save_policy(self, tree: Any, meta: dict[str, Any]) -> Path:
        """Save the final parameters.

        Raises:
            CheckpointError: they cannot be written.
        """
        checkpoint.save(self.policy_path, tree, meta)
        return self.policy_path

    def rewind(self, step: int) -> None:
        """Forget what came after ``step``, as the first act of resuming from its checkpoint.

        Later lines of metrics and half-written files of killed processes go, and DONE if it says that the run ended
        later; later checkpoints (damaged, or they would have been resumed from) are renamed to ``.damaged``.

        Raises:
            RunError: the metrics cannot be read or cut.
        """
        if self.finished and (end := int(self.summary().get("steps", step))) > step:
            (self.path / "DONE").unlink()
            said = f"it ended at step {end}, and goes on from step {max(step, 0)}"
            warnings.warn(f"{self.path} is not finished any more: {said}", stacklevel=2)
        truncate_metrics(self.metrics_path, step)
        late = [path for at, path in self.checkpoints() if at > step]
        torn = [path for place in (self.path, self.path / "checkpoints") for path in place.glob(".*.tmp")]
        for path in torn:
            with contextlib.suppress(OSError):
                path.unlink()
        for path in late:  # damaged, since a sound one would have been the newest: put aside, in case it is wanted
            with contextlib.suppress(OSError):
                path.replace(path.with_suffix(".damaged"))

    def open_metrics(self, tensorboard: bool = False) -> MetricsWriter:
        """The run's metrics, to be appended to.

        Raises:
            RunError: the file is damaged or cannot be opened, or the extra ``footwork[tb]`` is missing.
        """
        return MetricsWriter(self.metrics_path, self.path / "tensorboard" if tensorboard else None)

    def _refuse_occupied(self) -> None:
        names = {entry.name for entry in self.path.iterdir()}
        if all(name == "lock" or name.endswith(".tmp") for name in names):
            return
        elsewhere = "choose another --runs or --name"
        if "DONE" in names:
            raise RunError(f"run directory {self.path} holds a finished run: {elsewhere}")
        if "config.json" in names:
            raise RunError(f"run directory {self.path} holds an unfinished run: use --resume, or {elsewhere}")
        raise RunError(f"directory {self.path} is not empty and holds no run: {elsewhere}")


class MetricsWriter:
    """Appends to metrics.jsonl, one whole line at a time, and to TensorBoard event files on request.

    A torn last line, left by a killed process, is cut off on opening.

    Raises:
        RunError: the file is damaged or cannot be opened, or the extra ``footwork[tb]`` is missing.
    """

    def __init__(self, path: Path, tensorboard: Path | None = None) -> None:
        self.path = path
        self._last_step = truncate_metrics(path, None)
        self._events = None if tensorboard is None else _event_writer(tensorboard, self._last_step + 1)
        try:
            self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
        except OSError as error:
            raise RunError(f"cannot open {path}: {error.strerror or error}") from error

    def write(self, step: int, figures: Mapping[str, Any]) -> None:
        """Append one line: the step, then ``figures`` (numbers, arrays, strings, or mappings and lists of them).

        Raises:
            RunError: the step is before the last one, a figure is none of these, or the disk
                refused; the lines before are then intact.
        """
        if step < self._last_step:
            raise RunError(f"{self.path}: metrics of step {step} after those of step {self._last_step}")
        line = {"step": int(step), **_jsonable(figures, f"metrics of step {step}")}
        self._append(json.dumps(line, allow_nan=False).encode() + b"\n")
        self._last_step = step
        if self._events is not None:
            for name, value in _scalars("", line):
                self._events.add_scalar(name, value, step)

    def close(self) -> None:
        """Bring everything to the disk and let go of the files."""
        with contextlib.suppress(OSError):
            os.fsync(self._descriptor)
        os.close(self._descriptor)
        if self._events is not None:
            self._events.close()

    def __enter__(self) -> MetricsWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _append(self, line: bytes) -> None:
        size = os.fstat(self._descriptor).st_size
        try:
            rest = memoryview(line)
            while rest:
                rest = rest[os.write(self._descriptor, rest) :]
        except OSError as error:
            os.ftruncate(self._descriptor, size)
            reason = "no space left" if checkpoint.is_full(error) else f"{error.strerror or error}:"
            raise RunError(f"{reason} writing {self.path}; the lines before are intact") from error


def truncate_metrics(path: Path, step: int | None) -> int:
    """Cut the file after its last whole line, and after its last line up to ``step``; return the last step kept.

    A missing file is an empty one; the last step of an empty one is -1.

    Raises:
        RunError: a line other than the last is damaged, or the file cannot be read or cut.
    """
    try:
        data = path.read_bytes() if path.exists() else b""
        kept, last = _metrics_prefix(path, data, step)
        if kept < len(data):
            os.truncate(path, kept)
    except OSError as error:
        raise RunError(f"cannot cut {path}: {error.strerror or error}") from error
    return last


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """All whole lines of a metrics file, with "nan", "inf" and "-inf" as floats.

    Raises:
        RunError: the file cannot be read, or a line is damaged.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise RunError(f"cannot read {path}: {error.strerror or error}") from error
    kept, _ = _metrics_prefix(path, data, None)
    return [_with_floats(json.loads(line)) for line in data[:kept].splitlines()]


def config_to_json(config: Any) -> dict[str, Any]:
    """A dataclass, and those inside it, as JSON values; each carries its class name as "type".

    Fields hold None, bool, int, float, str, tuples and dataclasses.

    Raises:
        ValueError: ``config`` is no dataclass, or a field holds something else.
    """
    if not dataclasses.is_dataclass(config) or isinstance(config, type):
        raise ValueError(f"a config is a dataclass, got {type(config).__name__}")
    encoded: dict[str, Any] = _encode(config, type(config).__name__)
    return encoded


def config_from_json(cls: type[_Config], data: Any) -> _Config:
    """The inverse of :func:`config_to_json`: every field without a default must be there, and nothing unknown.

    A field that was added later, with a default that changes nothing, so reads from older files.

    "type" may be left out where the field allows one class only.

    Raises:
        ValueError: a field is unknown, missing or of another type, or the class refuses the values.
    """
    config: _Config = _decode(cls, data, cls.__name__)
    return config


def versions() -> dict[str, str]:
    """Of what a run's numbers depend on: the package, its source, Python, the libraries and the platform.

    The source's commit is among them where it is known (:func:`source_commit`), and what JAX computes on where that is
    not the CPU.
    """
    found = {
        "footwork": str(getattr(footwork, "__version__", "unknown")),
        "source": source_digest(),
        **({"commit": commit} if (commit := source_commit()) else {}),
        "python": platform.python_version(),
    }
    for name in ("jax", "mujoco", "numpy"):
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    for name in ("pybullet", "mujoco-mjx"):  # extras: engines
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    if (device := jax.devices()[0]).platform != "cpu":
        found["device"] = device.device_kind
    system = "-".join((platform.system(), platform.machine(), *filter(None, platform.libc_ver())))
    return {**found, "platform": system}


def device_in(versions: Mapping[str, str]) -> str:
    """What a run was computed on. Runs that do not say were made before GPUs were seen, or on the CPU."""
    return versions.get("device", "the CPU")


@functools.cache
def source_digest() -> str:
    """Eight digits that change with any line of the package's Python code: two checkouts of one version differ."""
    package = Path(footwork.__file__).parent
    digest = hashlib.blake2b(digest_size=4)
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


@functools.cache
def source_commit() -> str:
    """The commit that made the package's source what it is; empty if it was changed since, or lies in no repository."""
    package = Path(footwork.__file__).parent
    # A hook's git tells its children which repository it means: not ours.
    environment = {name: value for name, value in os.environ.items() if name not in _GIT_PLACES}

    def git(*arguments: str) -> str:
        command = ("git", "--no-optional-locks", "-C", str(package), *arguments)
        return subprocess.run(
            command, capture_output=True, text=True, timeout=10, check=True, env=environment
        ).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", "__init__.py")
        return (
            "" if git("status", "--porcelain", "--", ".") else git("log", "-1", "--abbrev=7", "--format=%h", "--", ".")
        )
    except (OSError, subprocess.SubprocessError):
        return ""


_GIT_PLACES = ("GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE")


class Progress:
    """How far a run is: live on a terminal, in lines as narrow as that is; elsewhere a plain line every few seconds."""

    def __init__(self, total_steps: int, label: str, stream: TextIO | None = None, initial_step: int = 0) -> None:
        self._total_steps = total_steps
        self._label = label
        self._stream = sys.stderr if stream is None else stream
        self._interval = 0.25 if self._stream.isatty() else 5.0  # s
        self._recent = deque([(time.monotonic(), initial_step)], maxlen=32)
        self._shown_at = time.monotonic()
        self._waiting: list[str] = []  # the newest line's parts, while it has not been shown
        self._live: Any = None

    def update(self, step: int, figures: Mapping[str, float]) -> None:
        """Say that ``step`` is reached, and the figures that matter."""
        now = time.monotonic()
        self._recent.append((now, step))
        self._waiting = self._parts(step, figures)
        if now - self._shown_at >= self._interval:
            self._show()
            self._shown_at = now

    def say(self, what: str) -> None:
        """Show a line of its own, before the first update."""
        self._stream.write(f"{self._label}  {what}\n")
        self._stream.flush()

    def close(self) -> None:
        """Show the last line and leave it standing."""
        if self._waiting:
            self._show()
        if self._live is not None:
            self._live.stop()
            self._live = None

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _parts(self, step: int, figures: Mapping[str, float]) -> list[str]:
        (then, first), (now, _) = self._recent[0], self._recent[-1]
        rate = (step - first) / max(now - then, 1e-9)
        parts = [self._label, f"{step:,}/{self._total_steps:,}", f"{step / max(self._total_steps, 1):.0%}"]
        parts.append(f"{rate:,.0f} steps/s")
        if rate > 0:
            parts.append(f"{timedelta(seconds=round(max(self._total_steps - step, 0) / rate))} left")
        return parts + [f"{name} {value:.4g}" for name, value in figures.items()]

    def _show(self) -> None:
        if self._stream.isatty():
            self._show_live()
        else:
            self._stream.write("  ".join(self._waiting) + "\n")
            self._stream.flush()
        self._waiting = []

    def _show_live(self) -> None:
        from rich.console import Console  # only a terminal needs it
        from rich.live import Live
        from rich.text import Text

        if self._live is None:
            self._live = Live(console=Console(file=self._stream), auto_refresh=False)
            self._live.start()
        lines = _folded(self._waiting, self._live.console.width)
        self._live.update(Text(lines, no_wrap=True, overflow="ellipsis"), refresh=True)


def _folded(parts: Sequence[str], width: int) -> str:
    """Parts side by side, in as many lines as a terminal's width asks for."""
    lines = [parts[0]]
    for part in parts[1:]:
        if len(lines[-1]) + 2 + len(part) <= width:
            lines[-1] += f"  {part}"
        else:
            lines.append(f"  {part}")
    return "\n".join(lines)


def _take(descriptor: int, path: Path) -> None:
    """Lock the open lock file and leave our process id in it."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = os.pread(descriptor, 32, 0).decode(errors="replace").strip()
        who = f"process {holder}" if holder else "another process"
        raise RunInUse(f"run directory {path} is in use by {who}") from None
    except OSError as error:
        raise RunError(f"cannot lock run directory {path}: {error.strerror or error}") from error
    with contextlib.suppress(OSError):  # the lock holds without the number too
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)


def _read_object(path: Path) -> dict[str, Any]:
    try:
        value = json.loads(path.read_bytes())
    except OSError as error:
        raise RunError(f"cannot read {path}: {error.strerror or error}") from error
    except (ValueError, RecursionError):  # the second: thousands of brackets
        value = None
    if not isinstance(value, dict):
        raise RunError(f"{path} is damaged: it holds no JSON object")
    return value


def _metrics_prefix(path: Path, data: bytes, step: int | None) -> tuple[int, int]:
    """How many bytes of a metrics file to keep, and the last step in them."""
    kept, last = 0, -1
    for number, line in enumerate(io.BytesIO(data), start=1):
        at = _step_of(line)
        if at is None and kept + len(line) < len(data):
            raise RunError(f"{path} is damaged: line {number} is not a line of metrics")
        if at is None or (step is not None and at > step):
            break
        kept, last = kept + len(line), at
    return kept, last


def _step_of(line: bytes) -> int | None:
    """The step of a line of metrics; None if it is torn or something else."""
    try:
        step = json.loads(line)["step"] if line.endswith(b"\n") else None
    except (KeyError, TypeError, ValueError):
        return None
    return step if isinstance(step, int) else None


def _jsonable(value: Any, where: str) -> Any:
    """Numbers and arrays as JSON values."""
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else str(float(value))
    if isinstance(value, Mapping):
        return {str(name): _jsonable(item, f"{where}: {name}") for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_jsonable(item, where) for item in value]
    if hasattr(value, "__array__"):
        return _jsonable(np.asarray(value).tolist(), where)
    raise RunError(f"{where}: neither a number nor an array: {type(value).__name__}")


def _with_floats(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _with_floats(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_with_floats(item) for item in value]
    return float(value) if isinstance(value, str) and value in _NOT_FINITE else value


def _scalars(name: str, value: Any) -> Iterator[tuple[str, float]]:
    """The numbers of a line of metrics under flat names, without the step."""
    if isinstance(value, Mapping | list):
        for part, item in value.items() if isinstance(value, Mapping) else enumerate(value):
            if (name, part) != ("", "step"):
                yield from _scalars(f"{name}/{part}" if name else str(part), item)
    elif isinstance(value, int | float) or (isinstance(value, str) and value in _NOT_FINITE):
        yield name, float(value)


def require_tensorboard() -> Any:
    """The class that writes event files.

    Raises:
        RunError: the extra ``footwork[tb]`` is missing.
    """
    try:
        from tensorboardX import SummaryWriter
    except ImportError:
        raise RunError("TensorBoard event files need an extra: pip install 'footwork[tb]'") from None
    return SummaryWriter


def _event_writer(directory: Path, next_step: int) -> Any:
    return require_tensorboard()(str(directory), purge_step=next_step)


def _encode(value: Any, where: str) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = [field.name for field in dataclasses.fields(value) if field.init]
        if "type" in fields:
            raise ValueError(f"{where}: a field of a config cannot be called type")
        named = {name: _encode(getattr(value, name), f"{where}.{name}") for name in fields}
        return {"type": type(value).__name__, **named}
    if isinstance(value, tuple):
        return [_encode(item, f"{where}[{index}]") for index, item in enumerate(value)]
    if isinstance(value, float) and not math.isfinite(value):
        return str(float(value))
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise ValueError(f"{where}: a config cannot hold a {type(value).__name__}")


def _decode(hint: Any, value: Any, where: str) -> Any:
    """The value as the type ``hint`` has it."""
    origin = typing.get_origin(hint)
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return _decode_dataclass(hint, value, where)
    if origin in (Union, types.UnionType):
        return _decode_union(typing.get_args(hint), value, where)
    if origin is tuple and isinstance(value, list):
        return _decode_tuple(typing.get_args(hint), value, where)
    if origin is Literal:
        fits = any(type(value) is type(choice) and value == choice for choice in typing.get_args(hint))
    elif hint is float:
        if isinstance(value, str) and value in _NOT_FINITE:
            return float(value)
        fits = type(value) in (float, int)
    else:
        fits = hint in (bool, int, str, types.NoneType) and type(value) is hint
    if fits:
        return value
    raise ValueError(f"{where}: expected {_spell(hint)}, got {value!r}")


def _decode_dataclass(cls: type, value: Any, where: str) -> Any:
    if not isinstance(value, dict):
        raise ValueError(f"{where}: expected {cls.__name__}, got {value!r}")
    tag = value.get("type", cls.__name__)
    if tag != cls.__name__:
        raise ValueError(f"{where}: expected {cls.__name__}, got {tag}")
    fields = [field.name for field in dataclasses.fields(cls) if field.init]
    optional = {field.name for field in dataclasses.fields(cls) if field.default is not dataclasses.MISSING}
    unknown = sorted(set(value) - set(fields) - {"type"})
    missing = [name for name in fields if name not in value and name not in optional]
    if unknown or missing:
        parts = [f"{word} {', '.join(names)}" for word, names in (("unknown", unknown), ("missing", missing)) if names]
        raise ValueError(f"{where}: {'; '.join(parts)}; the fields of {cls.__name__} are {', '.join(fields)}")
    hints = typing.get_type_hints(cls)
    given = [name for name in fields if name in value]
    return cls(**{name: _decode(hints[name], value[name], f"{where}.{name}") for name in given})


def _decode_union(members: tuple[Any, ...], value: Any, where: str) -> Any:
    if isinstance(value, dict):
        classes = {m.__name__: m for m in members if isinstance(m, type) and dataclasses.is_dataclass(m)}
        tag = value.get("type", next(iter(classes)) if len(classes) == 1 else None)
        if tag not in classes:
            raise ValueError(f"{where}: unknown type {tag!r}, known are {', '.join(classes) or 'none'}")
        return _decode_dataclass(classes[tag], value, where)
    for member in members:
        with contextlib.suppress(ValueError):
            return _decode(member, value, where)
    raise ValueError(f"{where}: expected {' | '.join(map(_spell, members))}, got {value!r}")


def _decode_tuple(members: tuple[Any, ...], value: list[Any], where: str) -> tuple[Any, ...]:
    if len(members) == 2 and members[1] is Ellipsis:
        members = members[:1] * len(value)
    if len(members) != len(value):
        raise ValueError(f"{where}: expected {len(members)} values, got {len(value)}")
    pairs = enumerate(zip(members, value, strict=True))
    return tuple(_decode(member, item, f"{where}[{index}]") for index, (member, item) in pairs)


def _spell(hint: Any) -> str:
    return "None" if hint is types.NoneType else hint.__name__ if isinstance(hint, type) else str(hint)


__all__ = [
    "KEEP_CHECKPOINTS",
    "Latest",
    "MetricsWriter",
    "Progress",
    "RunDir",
    "RunError",
    "RunInUse",
    "config_from_json",
    "config_to_json",
    "read_metrics",
    "require_tensorboard",
    "source_commit",
    "source_digest",
    "truncate_metrics",
    "versions",
]
