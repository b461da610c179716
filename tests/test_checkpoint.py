"""Laws of checkpoints: what was saved comes back bit for bit, and anything else is refused by name."""

from __future__ import annotations

import contextlib
import errno
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as stnp

from footwork import checkpoint
from footwork.checkpoint import CheckpointError


class Learner(NamedTuple):
    params: Any
    key: Any
    count: Any


def learner() -> Learner:
    return Learner(
        params={"actor": (jnp.arange(6.0).reshape(2, 3), jnp.zeros(3, jnp.bfloat16)), "none": None},
        key=jax.random.split(jax.random.key(7), 3),
        count=np.array(2**40 + 1, np.int64),
    )


def bits(leaf: Any) -> tuple[str, tuple[int, ...], bytes]:
    data = jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf
    return str(leaf.dtype), tuple(leaf.shape), np.asarray(data).tobytes()


def assert_same(one: Any, other: Any) -> None:
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert isinstance(b, jax.Array) == isinstance(a, jax.Array)
        assert bits(a) == bits(b)


NUMPY_TYPES = ["bool", "int8", "uint16", "int32", "int64", "float16", "float32", "float64", ">f4", "complex128"]
NUMPY_TYPES += ["complex64", "M8[ns]", "<U3"]
arrays = st.sampled_from(NUMPY_TYPES).flatmap(lambda d: stnp.arrays(d, stnp.array_shapes(min_dims=0, min_side=0)))
jax_arrays = st.sampled_from(["bool", "int32", "float32"]).flatmap(
    lambda d: stnp.arrays(d, stnp.array_shapes(min_dims=0, max_side=3)).map(jnp.array)
)
keys = st.integers(0, 2**31 - 1).map(jax.random.key) | st.just(jax.random.key(1, impl="rbg"))
names = st.text(max_size=4) | st.sampled_from(["a/b", "~", "__metadata__", "\x1f", "checksum"])
trees = st.recursive(
    arrays | jax_arrays | keys | st.none(),
    lambda inner: (
        st.dictionaries(names, inner, max_size=3)
        | st.tuples(inner, inner)
        | st.lists(inner, max_size=2)
        | st.builds(Learner, inner, inner, inner)
    ),
    max_leaves=8,
)


@given(tree=trees, steps=st.integers(0, 2**60), name=st.text(max_size=9))
@settings(max_examples=30, deadline=None, suppress_health_check=list(HealthCheck))
def test_any_tree_comes_back_bit_for_bit_and_the_same_tree_is_the_same_file(tree, steps, name, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "any.safetensors"
    meta = {"step": steps, "row": name, "nested": [1.5, None]}
    checkpoint.save(path, tree, meta)
    loaded, found = checkpoint.load(path, tree)
    assert found == meta
    assert_same(tree, loaded)
    first = path.read_bytes()
    checkpoint.save(path, loaded, found)
    assert path.read_bytes() == first


def test_not_a_number_keeps_its_payload(tmp_path):
    path = tmp_path / "c.safetensors"
    strange = np.array([0x7FC00001, 0xFF800001, 0x80000000, 1], np.uint32).view(np.float32)
    tree = {"numpy": strange, "jax": jax.device_put(strange)}
    checkpoint.save(path, tree, {})
    assert_same(tree, checkpoint.load(path, tree)[0])


def test_shapes_alone_are_enough_to_load(tmp_path):
    path = tmp_path / "c.safetensors"
    state = Learner(jnp.ones((2, 3)), jax.random.key(4), jnp.array(5))
    checkpoint.save(path, state, {})
    loaded, _ = checkpoint.load(path, jax.eval_shape(lambda: state))
    assert_same(state, loaded)
    checkpoint.save(path, np.arange(3.0), {})
    loaded, _ = checkpoint.load(path, jax.ShapeDtypeStruct((3,), np.float64))
    assert loaded.dtype == np.float64


def test_loaded_numpy_arrays_are_writable_and_stand_for_themselves(tmp_path):
    path = tmp_path / "c.safetensors"
    tree = {"a": np.zeros(3), "b": np.float32(2.5)}
    checkpoint.save(path, tree, {})
    loaded, _ = checkpoint.load(path, tree)
    loaded["a"][0] = 1
    assert isinstance(loaded["b"], np.float32)
    assert checkpoint.load(path, tree)[0]["a"][0] == 0


def test_names_are_the_places_in_the_tree_and_other_readers_can_read_them(tmp_path):
    path = tmp_path / "c.safetensors"
    checkpoint.save(path, learner(), {"step": 3})
    found, meta = checkpoint.load_arrays(path)
    assert set(found) == {"params/actor/0", "params/actor/1", "key", "count"}
    assert meta == {"step": 3}
    assert found["params/actor/1"].dtype == jnp.bfloat16
    plain = safetensors.numpy.load_file(path)
    np.testing.assert_array_equal(plain["params/actor/0"], np.arange(6.0).reshape(2, 3))


@pytest.mark.parametrize("leaf", [3, 2.5, True, "text", np.array([object()]), np.zeros(1, [("a", "i4")])])
def test_a_leaf_that_is_no_array_of_numbers_is_refused_and_named(tmp_path, leaf):
    path = tmp_path / "c.safetensors"
    with pytest.raises(CheckpointError, match="leaf place "):
        checkpoint.save(path, {"place": leaf}, {})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("meta", [{"x": float("nan")}, {"x": object()}])
def test_meta_that_is_not_json_is_refused(tmp_path, meta):
    with pytest.raises(CheckpointError, match="meta is not JSON"):
        checkpoint.save(tmp_path / "c.safetensors", learner(), meta)


def test_another_structure_shape_or_type_is_refused_and_named(tmp_path):
    path = tmp_path / "c.safetensors"
    checkpoint.save(path, {"a": jnp.ones((2, 3)), "k": jax.random.key(0)}, {})
    key = jax.random.key(0)
    for like, words in [
        ({"a": jnp.ones((2, 3)), "k": key, "b": jnp.ones(1)}, ["missing b"]),
        ({"a": jnp.ones((2, 3))}, ["unexpected k"]),
        ({"a": jnp.ones((3, 2)), "k": key}, ["leaf a ", "(2, 3)", "(3, 2)"]),
        ({"a": jnp.ones((2, 3), jnp.int32), "k": key}, ["leaf a ", "float32", "int32"]),
        ({"a": np.ones((2, 3)), "k": key}, ["leaf a ", "float32", "float64"]),
        ({"a": jnp.ones((2, 3)), "k": jax.random.key(0, impl="rbg")}, ["leaf k ", "fry", "rbg"]),
        ({"a": jnp.ones((2, 3)), "k": jax.random.key_data(key)}, ["leaf k ", "key<fry>", "uint32"]),
        ({"a": key, "k": key}, ["leaf a ", "float32", "key<fry>"]),
        ({"a": 1.0, "k": key}, ["leaf a ", "float"]),
    ]:
        refuse(path, *words, like=like)


def refuse(path: Path, *words: str, like: Any = None) -> None:
    """Loading says so in one line that names the file."""
    with pytest.raises(CheckpointError) as caught:
        checkpoint.load_arrays(path) if like is None else checkpoint.load(path, like)
    message = str(caught.value)
    assert "\n" not in message
    for word in (str(path), *words):
        assert word in message


def test_missing_and_foreign_files_are_refused(tmp_path):
    path = tmp_path / "c.safetensors"
    refuse(path, "no such checkpoint")
    refuse(tmp_path, "cannot be read")
    for foreign in (b"", b"{}", b"step,reward\n1,2\n" * 20, b"\x80\x04N.", b"\x02\0\0\0\0\0\0\0[]", os.urandom(500)):
        path.write_bytes(foreign)
        refuse(path, "not a checkpoint of Footwork")
    for metadata in (None, {"format": "pt"}, {"footwork": "1"}, {"footwork": "{}"}):
        path.write_bytes(safetensors.numpy.save({"a": np.ones(2)}, metadata))
        refuse(path)
    checkpoint.save(path, learner(), {})
    path.write_bytes(path.read_bytes().replace(b"footwork-checkpoint/1", b"footwork-checkpoint/2"))
    refuse(path, "footwork-checkpoint/2", "footwork-checkpoint/1")


META = {"step": 12, "row": "maze/hrl/plain", "rate": 1e-05, "checksum": "0123456789abcdef" * 2, "name": "\u00e9\n"}


def test_truncation_and_extension_are_refused(tmp_path):
    path = tmp_path / "c.safetensors"
    checkpoint.save(path, learner(), META)
    whole = path.read_bytes()
    for length in {*range(0, len(whole), 5), *range(len(whole) - 9, len(whole))}:
        path.write_bytes(whole[:length])
        refuse(path)
    path.write_bytes(whole + b"\0")
    refuse(path, "damaged")


def test_a_single_flipped_bit_in_any_byte_is_refused(tmp_path):
    path = tmp_path / "c.safetensors"
    checkpoint.save(path, learner(), META)
    whole = path.read_bytes()
    for place in range(len(whole)):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << (place * 3 % 8)
        path.write_bytes(damaged)
        refuse(path)
    path.write_bytes(whole)
    assert checkpoint.load_arrays(path)[1] == META


# A second save of the file is killed: by the kernel in the middle of writing, or by itself before or after a call.
KILLED_AT = """
import os, resource, signal, sys
from pathlib import Path
import numpy as np
from footwork import checkpoint

file, moment, call = Path(sys.argv[1]), *sys.argv[2].split()
save = lambda step: checkpoint.save(file, {"a": np.full(200_000, step)}, {"step": step})
save(1)
if call == "writing":
    signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
    resource.setrlimit(resource.RLIMIT_FSIZE, (500_000, resource.RLIM_INFINITY))
else:
    whole = getattr(os, call)

    def deadly(*arguments):
        if moment == "after":
            whole(*arguments)
        os.kill(os.getpid(), signal.SIGKILL)

    setattr(os, call, deadly)
save(2)
"""


@pytest.mark.parametrize(
    ("moment", "step"),
    {"while writing": 1, "before fsync": 1, "after fsync": 1, "before replace": 1, "after replace": 2}.items(),
)
def test_kill_9_at_any_moment_of_a_write_leaves_a_whole_checkpoint(tmp_path, moment, step):
    file = tmp_path / "c.safetensors"
    environment = {"PYTHONPATH": os.pathsep.join(sys.path), "PATH": os.environ["PATH"]}
    command = [sys.executable, "-c", KILLED_AT, str(file), moment]
    killed_by = -subprocess.run(command, env=environment, timeout=60).returncode
    assert killed_by == (signal.SIGXFSZ if moment == "while writing" else signal.SIGKILL)
    assert len(list(tmp_path.glob(".*.tmp"))) == (2 - step)  # what was being written is never the file itself
    arrays, meta = checkpoint.load_arrays(file)
    assert meta["step"] == step
    np.testing.assert_array_equal(arrays["a"], np.full(200_000, step))


@contextlib.contextmanager
def files_no_larger_than(size: int) -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def assert_full_disk_harms_nothing(path: Path, before: bytes) -> None:
    assert path.read_bytes() == before
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize("size", [0, 100, 5000])
def test_a_disk_that_fills_up_keeps_the_earlier_checkpoint(tmp_path, size):
    path = tmp_path / "c.safetensors"
    checkpoint.save(path, learner(), {"step": 1})
    before = path.read_bytes()
    with (
        files_no_larger_than(size),
        pytest.raises(CheckpointError, match=r"no space left writing .*; the previous checkpoint is intact"),
    ):
        checkpoint.save(path, {"a": np.zeros(10_000)}, {"step": 2})
    assert_full_disk_harms_nothing(path, before)


@pytest.mark.parametrize("call", ["fsync", "replace", "open"])
def test_a_full_disk_at_any_call_keeps_the_earlier_checkpoint(tmp_path, monkeypatch, call):
    path = tmp_path / "c.safetensors"
    checkpoint.save(path, learner(), {"step": 1})
    before = path.read_bytes()

    def refuse_call(*_: Any, **__: Any) -> Any:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(*((checkpoint, "open") if call == "open" else (os, call)), refuse_call, raising=False)
        with pytest.raises(CheckpointError, match="no space left"):
            checkpoint.save(path, learner(), {"step": 2})
    assert_full_disk_harms_nothing(path, before)


def test_an_interrupt_leaves_nothing_behind(tmp_path, monkeypatch):
    path = tmp_path / "c.safetensors"
    checkpoint.save(path, learner(), {"step": 1})
    before = path.read_bytes()

    def interrupt(_: int) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", interrupt)
        with pytest.raises(KeyboardInterrupt):
            checkpoint.save(path, learner(), {"step": 2})
    assert_full_disk_harms_nothing(path, before)


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(CheckpointError, match=r"cannot write .*file/c.safetensors"):
        checkpoint.save(tmp_path / "file" / "c.safetensors", learner(), {})


def test_a_leaf_returns_to_the_devices_it_was_committed_to(tmp_path):
    path = tmp_path / "c.safetensors"
    device = jax.devices()[-1]
    tree = {"free": jnp.ones(2), "bound": jax.device_put(jnp.ones(2), device)}
    checkpoint.save(path, tree, {})
    loaded, _ = checkpoint.load(path, tree)
    assert loaded["bound"].committed
    assert loaded["bound"].devices() == {device}
    assert not loaded["free"].committed
