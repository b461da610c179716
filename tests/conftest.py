"""Set before anything imports JAX: one CPU device, one thread per operation; then the pure modules' array checks."""

import os
from importlib.util import find_spec
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Tests share the cores by processes; a thread pool in each of them would only get in the way. Most of their time is
# compilation: little of it is optimised, the emitters are the ones that compile fastest (a fifth less CPU time in
# all), and none is done twice, not even by the processes that a test starts. With FOOTWORK_SLOW=1 programs are compiled
# as they are for users.
FLAGS = ["--xla_cpu_multi_thread_eigen=false"]
if os.environ.get("FOOTWORK_SLOW") != "1":
    FLAGS += [
        "--xla_backend_optimization_level=0",
        "--xla_cpu_use_fusion_emitters=false",
        "--xla_cpu_parallel_codegen_split_count=1",
    ]
os.environ["XLA_FLAGS"] = " ".join([os.environ.get("XLA_FLAGS", ""), *FLAGS]).strip()
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
os.environ.setdefault("MPLBACKEND", "agg")

import hypothesis  # noqa: E402
from jaxtyping import install_import_hook  # noqa: E402

# Every call of these modules' functions is checked against its signature, shapes included.
# Under jit that happens while JAX traces, once per compilation.
CHECKED = ("footwork.rotations", "footwork.tasks", "footwork.learn.gae", "footwork.learn.ppo")
if find_spec("beartype") and os.environ.get("FOOTWORK_CHECK_SHAPES", "1") != "0":
    install_import_hook(CHECKED, "beartype.beartype")

# The same examples in every run, and no deadline: the first example pays for compilation.
hypothesis.settings.register_profile("footwork", deadline=None, derandomize=True, database=None, print_blob=True)
hypothesis.settings.load_profile("footwork")
