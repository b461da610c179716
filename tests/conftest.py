"""Set before anything imports JAX: one CPU device, one thread per operation; then the pure modules' array checks."""

import os
from importlib.util import find_spec

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Tests share the cores by processes; a thread pool in each of them would only get in the way.
os.environ["XLA_FLAGS"] = " ".join([os.environ.get("XLA_FLAGS", ""), "--xla_cpu_multi_thread_eigen=false"]).strip()
os.environ.setdefault("MPLBACKEND", "agg")

import hypothesis
from jaxtyping import install_import_hook

# Every call of these modules' functions is checked against its signature, shapes included.
# Under jit that happens while JAX traces, once per compilation.
CHECKED = ("footwork.rotations", "footwork.tasks", "footwork.learn.gae", "footwork.learn.ppo")
if find_spec("beartype") and os.environ.get("FOOTWORK_CHECK_SHAPES", "1") != "0":
    install_import_hook(CHECKED, "beartype.beartype")

# The same examples in every run, and no deadline: the first example pays for compilation.
hypothesis.settings.register_profile("footwork", deadline=None, derandomize=True, database=None, print_blob=True)
hypothesis.settings.load_profile("footwork")
