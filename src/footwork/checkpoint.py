"""Checkpoints: any pytree of arrays in one file that is whole or not there at all.

A checkpoint is a safetensors file. Each leaf is a tensor named after its place in
the tree (``policy/actor/0/kernel``), so any safetensors reader can open it. One
metadata entry, ``footwork``, holds JSON: the format, a checksum of the whole file,
how to read the leaves that safetensors has no type for, and the caller's ``meta``.

Two laws. What was saved comes back bit for bit, and the same tree gives the same
file. A file that was cut short, damaged in a single bit or written by something
else is refused: by one :class:`CheckpointError` that names it, never by wrong numbers.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import re
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import safetensors
import safetensors.numpy

FORMAT = "footwork-checkpoint/1"

# What safetensors' numpy reader gives back as it was; everything else is stored as bytes.
_NATIVE = frozenset(
    {"bool", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64"}
    | {"float16", "float32", "float64", "complex64"}
)
_NO_SPACE = frozenset((errno.ENOSPC, errno.EDQUOT, errno.EFBIG))
_BLANK = "0" * 32  # where the checksum goes; the file is hashed with this in its place
_MARK = b'\\"checksum\\":\\"'  # as it stands in the header: JSON inside a JSON string


class CheckpointError(ValueError):
    """A file could not be written, or is not the checkpoint it should be. One line, naming the file."""


def save(path: Path, tree: Any, meta: dict[str, Any]) -> None:
    """Write the arrays of ``tree`` and the JSON object ``meta`` to ``path``, atomically.

    Leaves may be jax arrays, typed jax keys, numpy arrays and numpy scalars of any type
    without Python objects in it; ``None`` is structure, as everywhere in JAX. A process
    killed at any moment leaves either the earlier file or the new one.

    Raises:
        CheckpointError: a leaf is no array (a Python number belongs into ``meta``, or into
            an array), ``meta`` is not JSON, or the file cannot be written, as on a full disk;
            an earlier file at ``path`` is then untouched.
    """
    tensors: dict[str, np.ndarray] = {}
    keys: dict[str, str] = {}
    packed: dict[str, str] = {}
    for name, leaf in _named_leaves(tree):
        array, impl = _to_numpy(path, name, leaf)
        if impl is not None:
            keys[name] = impl
        if array.dtype.name not in _NATIVE or not array.dtype.isnative:
            packed[name] = str(array.dtype)
            array = _pack(path, name, array)
        tensors[name] = array
    record = {"checksum": _BLANK, "format": FORMAT, "keys": keys, "packed": packed, "meta": meta}
    try:
        text = json.dumps(record, allow_nan=False, separators=(",", ":"))
    except (TypeError, ValueError) as error:
        raise CheckpointError(f"{path}: the checkpoint's meta is not JSON: {error}") from None
    data = safetensors.numpy.save(tensors, metadata={"footwork": text})
    start = data.index(_MARK) + len(_MARK)
    sealed = (data[:start], _checksum(data, start).encode(), data[start + len(_BLANK) :])
    write_atomically(path, sealed, what="checkpoint")


def load(path: Path, like: Any) -> tuple[Any, dict[str, Any]]:
    """Read ``path`` into the structure of ``like``, bit for bit; return the tree and ``meta``.

    ``like`` gives structure, shapes and types: arrays or ``jax.ShapeDtypeStruct``. A numpy
    leaf comes back as numpy, writable; a jax leaf as jax, on the devices that leaf is committed to;
    a ShapeDtypeStruct as jax where JAX can hold its type (float64 only with x64), else as numpy.

    Raises:
        CheckpointError: the file is missing, truncated, damaged or foreign, a leaf is missing
            or unexpected, or has another shape or type than in ``like``.
    """
    contents = _read(path)
    wanted = dict(_named_leaves(like))
    absent = [name for name in wanted if name not in contents.arrays]
    extra = [name for name in contents.arrays if name not in wanted]
    if absent or extra:
        parts = [f"{word} {_listing(names)}" for word, names in (("missing", absent), ("unexpected", extra)) if names]
        raise CheckpointError(f"{path}: the checkpoint's leaves do not match: {'; '.join(parts)}")
    leaves = [
        _restore(path, name, contents.arrays[name], contents.keys.get(name), leaf) for name, leaf in wanted.items()
    ]
    return jax.tree_util.tree_unflatten(jax.tree_util.tree_structure(like), leaves), contents.meta


def load_arrays(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read ``path`` as plain arrays by name, and ``meta``; a jax key comes as its integers.

    Raises:
        CheckpointError: the file is missing, truncated, damaged or foreign.
    """
    contents = _read(path)
    return contents.arrays, contents.meta


def write_atomically(path: Path, data: bytes | Iterable[bytes], what: str = "file") -> None:
    """Put ``data`` at ``path`` so that a crash at any moment leaves the old file or the new one.

    The data go to a temporary name in the same directory (made if need be), reach the disk,
    and are then renamed.

    Raises:
        CheckpointError: the system refused; nothing is left behind, and an earlier file is untouched.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(temporary, "wb") as file:
            file.writelines((data,) if isinstance(data, bytes) else data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        if not isinstance(error, OSError):
            raise
        failed = (
            f"no space left writing {path}" if is_full(error) else f"cannot write {path}: {error.strerror or error}"
        )
        raise CheckpointError(f"{failed}; the previous {what} is intact") from error
    _sync_directory(path.parent)


def check_writable(path: Path) -> None:
    """Refuse, before the work is done, a place where no file could be put; makes its directory.

    Raises:
        CheckpointError: it is a directory, or nothing can be written beside it.
    """
    if path.is_dir():
        raise CheckpointError(f"cannot write {path}: it is a directory, and the name of a file is wanted")
    if path.parent.is_file():
        raise CheckpointError(f"cannot write {path}: {path.parent} is a file, and a folder is wanted")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise CheckpointError(f"cannot write {path}: {error.strerror or error}") from error


def is_full(error: OSError) -> bool:
    """Whether the system refused for want of space: disk, quota or the process's own limit."""
    return error.errno in _NO_SPACE


class _Contents(NamedTuple):
    arrays: dict[str, np.ndarray]
    keys: dict[str, str]  # names of leaves that are jax keys, and their kind
    meta: dict[str, Any]


def _named_leaves(tree: Any) -> list[tuple[str, Any]]:
    """Leaves with names that are unique in the tree: parts joined by slashes, slashes in parts escaped."""
    flat, _ = jax.tree_util.tree_flatten_with_path(tree)
    return [(_name(path), leaf) for path, leaf in flat]


def _name(path: tuple[Any, ...]) -> str:
    parts = [jax.tree_util.keystr((part,), simple=True) for part in path]
    name = "/".join(part.replace("~", "~0").replace("/", "~1") for part in parts)
    return "~" + name if name in ("", "__metadata__") else name  # the second is safetensors' own


def _to_numpy(path: Path, name: str, leaf: Any) -> tuple[np.ndarray, str | None]:
    """The leaf's numbers, contiguous, and its kind of key if it is one."""
    if not isinstance(leaf, jax.Array | np.ndarray | np.generic):
        raise CheckpointError(f"{path}: leaf {name} is a Python {type(leaf).__name__}, not an array")
    if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return np.asarray(jax.random.key_data(leaf), order="C"), str(jax.random.key_impl(leaf))
    return np.asarray(leaf, order="C"), None


def _pack(path: Path, name: str, array: np.ndarray) -> np.ndarray:
    """The bytes of an array whose type safetensors does not read back, on a last axis of their own."""
    dtype = array.dtype
    if dtype.hasobject or dtype.names or dtype.itemsize == 0:
        raise CheckpointError(f"{path}: leaf {name} has type {dtype}, which a checkpoint cannot hold")
    return np.frombuffer(array.tobytes(), np.uint8).reshape(*array.shape, dtype.itemsize)


def _unpack(array: np.ndarray, dtype: str) -> np.ndarray:
    return np.ndarray(array.shape[:-1], np.dtype(dtype), buffer=array.tobytes())


def _checksum(data: bytes, start: int) -> str:
    """Of the whole file, with the checksum itself, which stands at ``start``, left blank."""
    view = memoryview(data)
    digest = hashlib.blake2b(view[:start], digest_size=len(_BLANK) // 2)
    digest.update(_BLANK.encode())
    digest.update(view[start + len(_BLANK) :])
    return digest.hexdigest()


def _read(path: Path) -> _Contents:
    """Read the file and believe nothing of it before format and checksum agree."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise CheckpointError(f"{path}: no such checkpoint") from None
    except OSError as error:
        raise CheckpointError(f"{path}: the checkpoint cannot be read: {error.strerror or error}") from error
    header = data[8 : 8 + int.from_bytes(data[:8], "little")]
    record = _record(path, header)
    if record.get("format") != FORMAT:
        raise CheckpointError(f"{path}: format is {record.get('format')!r}, this version reads {FORMAT!r}")
    found = re.search(re.escape(_MARK) + rb"([0-9a-f]{32})", header)
    if found is None or found[1].decode() != _checksum(data, 8 + found.start(1)):
        raise CheckpointError(f"{path}: the checkpoint is damaged, its checksum does not match")
    try:
        tensors = safetensors.numpy.load(data)
        packed = record["packed"]
        arrays = {n: _unpack(a, packed[n]) if n in packed else a for n, a in tensors.items()}
        writable = {name: array.copy() for name, array in arrays.items()}
        return _Contents(writable, record["keys"], record["meta"])
    except (safetensors.SafetensorError, KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{path}: the checkpoint cannot be read here: {error}") from error


def _record(path: Path, header: bytes) -> dict[str, Any]:
    """Our entry in the safetensors header."""
    try:
        entry = json.loads(header)["__metadata__"]
        text = entry["footwork"]
        record = json.loads(text)
        if not isinstance(record, dict):
            raise TypeError
        return record
    except (KeyError, TypeError, ValueError, RecursionError):
        raise CheckpointError(
            f"{path}: not a checkpoint of Footwork: truncated, damaged or written by something else"
        ) from None


def _restore(path: Path, name: str, found: np.ndarray, impl: str | None, like: Any) -> Any:
    """The leaf as ``like`` has it, once shape and type are what they should be."""
    if not (hasattr(like, "shape") and hasattr(like, "dtype")):
        raise CheckpointError(f"{path}: leaf {name} of the expected tree is a Python {type(like).__name__}, no array")
    value: Any = found
    if impl is not None:
        try:
            value = jax.random.wrap_key_data(jnp.array(found), impl=impl)
        except ValueError:
            raise CheckpointError(f"{path}: leaf {name} is a key of unknown kind {impl!r}") from None
    if tuple(value.shape) != tuple(like.shape) or str(value.dtype) != str(like.dtype):
        raise CheckpointError(
            f"{path}: leaf {name} has shape {tuple(value.shape)} and type {value.dtype}, "
            f"expected {tuple(like.shape)} and {like.dtype}"
        )
    if isinstance(like, np.ndarray):
        return value
    if isinstance(like, np.generic):
        return value[()]
    if impl is None and (isinstance(like, jax.Array) or _jax_holds(found.dtype)):
        value = jnp.array(value)  # a copy: JAX may otherwise alias numpy's memory
    if isinstance(like, jax.Array) and like.committed:
        value = jax.device_put(value, like.sharding)
    return value


def _jax_holds(dtype: np.dtype) -> bool:
    try:
        return bool(dtype.isnative and jax.dtypes.canonicalize_dtype(dtype) == dtype)
    except TypeError:
        return False


def _listing(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def _sync_directory(directory: Path) -> None:
    """Make a rename last through a power cut; the file is whole either way, so a refusal is not an error."""
    with contextlib.suppress(OSError):
        descriptor = os.open(directory, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


__all__ = ["FORMAT", "CheckpointError", "is_full", "load", "load_arrays", "save", "write_atomically"]
