"""Policies as ONNX files: the sub-policies, one file per direction; a master or a flat policy, one file.

Every file maps ``obs`` [N, D] float32 to ``action`` (the mode) and to what the
distribution needs to be sampled: ``mean`` and ``log_std``, or ``logits``. A symmetric
sub-policy has its quarter turn written into the graph.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

try:
    import onnx
    from onnx import TensorProto, helper, numpy_helper
except ImportError as error:
    raise ImportError(f"writing ONNX needs the extra: pip install 'footwork[onnx]' ({error})") from None

import footwork
from footwork.arena import DIRECTIONS
from footwork.checkpoint import write_atomically
from footwork.learn.networks import Gaussian, Policy
from footwork.tasks.observe import WALKER_OBS_SIZE, turn_action, turn_observation
from footwork.train import Trained
from footwork.types import Params

OPSET = 18
_LINEAR = 21  # joints, feet and height: a quarter turn only relabels them


def write_onnx(trained: Trained, to: Path, seed_index: int = 0) -> list[Path]:
    """Write one seed's policies into the folder ``to``.

    Raises:
        CheckpointError: a file cannot be written.
    """
    policy, experiment = trained.experiment.policy(), trained.experiment
    leaves: dict[str, Any] = {"actor": trained.params["actor"]}
    if not experiment.is_walker:
        return [_write(to / "policy.onnx", _Graph(policy, _pick(leaves, seed_index, 0)))]
    return [
        _write(
            to / f"{name}.onnx",
            _Graph(
                policy,
                _pick(leaves, seed_index, 0 if experiment.symmetric else turns),
                turns if experiment.symmetric else 0,
            ),
        )
        for turns, name in enumerate(DIRECTIONS)
    ]


def _pick(params: Params, seed_index: int, run: int) -> Params:
    return {
        layer: {name: np.asarray(leaf)[seed_index, run] for name, leaf in parts.items()}
        for layer, parts in params["actor"].items()
    }


def _write(path: Path, graph: _Graph) -> Path:
    model = graph.model()
    onnx.checker.check_model(model)
    write_atomically(path, model.SerializeToString())
    return path


class _Graph:
    """An actor as ONNX nodes; ``turns`` quarter turns about it where it is symmetric."""

    def __init__(self, policy: Policy, actor: dict[str, dict[str, np.ndarray]], turns: int = 0):
        self._nodes: list[Any] = []
        self._constants: list[Any] = []
        self._policy = policy
        obs = self._turned("obs", turns) if turns else "obs"
        outputs = self._net(actor, obs)
        self._outputs = (
            self._gaussian(outputs, turns) if isinstance(policy.head, Gaussian) else self._categorical(outputs)
        )

    def model(self) -> Any:
        """The finished model."""
        obs = helper.make_tensor_value_info("obs", TensorProto.FLOAT, ["N", self._policy.obs_size])
        graph = helper.make_graph(self._nodes, "footwork", [obs], self._outputs, self._constants)
        opset = [helper.make_opsetid("", OPSET)]
        return helper.make_model(
            graph, opset_imports=opset, ir_version=9, producer_name="footwork", producer_version=footwork.__version__
        )

    def _add(self, kind: str, *inputs: Any, name: str | None = None, **attributes: Any) -> str:
        """One node; arrays among its inputs become constants. Its output's name."""
        output = name or f"{kind.lower()}_{len(self._nodes)}"
        names = [item if isinstance(item, str) else self._constant(item) for item in inputs]
        self._nodes.append(helper.make_node(kind, names, [output], **attributes))
        return output

    def _constant(self, value: Any) -> str:
        array = np.asarray(value)
        if array.dtype not in (np.int64, np.bool_):
            array = array.astype(np.float32)
        name = f"constant_{len(self._constants)}"
        self._constants.append(numpy_helper.from_array(array, name))
        return name

    def _columns(self, of: str, start: int, stop: int) -> str:
        return self._add("Slice", of, np.array([start]), np.array([stop]), np.array([1]))

    def _net(self, actor: dict[str, dict[str, np.ndarray]], x: str) -> str:
        for number in range(len(actor) - 1):
            layer = actor[f"hidden_{number + 1}"]
            x = self._add("Tanh", self._add("Gemm", x, layer["weight"], layer["bias"]))
        return self._add("Gemm", x, actor["output"]["weight"], actor["output"]["bias"])

    def _categorical(self, outputs: str) -> list[Any]:
        logits = self._add("Identity", outputs, name="logits")
        self._add("ArgMax", logits, axis=1, keepdims=0, name="action")
        return [
            helper.make_tensor_value_info("action", TensorProto.INT64, ["N"]),
            helper.make_tensor_value_info("logits", TensorProto.FLOAT, ["N", self._policy.head.num_outputs]),
        ]

    def _gaussian(self, outputs: str, turns: int) -> list[Any]:
        """The mean, and the deviations between their bounds; both turned back."""
        head = self._policy.head
        assert isinstance(head, Gaussian)
        size = head.action_size
        span = head.max_log_std - head.min_log_std
        level = (head.initial_log_std - head.min_log_std) / span
        raw = self._columns(outputs, size, 2 * size)
        shifted = self._add("Add", self._add("Mul", raw, 1 / (span * level * (1 - level))), np.log(level / (1 - level)))
        log_std = self._add("Add", self._add("Mul", self._add("Sigmoid", shifted), span), head.min_log_std)
        mean = self._columns(outputs, 0, size)
        if turns:
            back = np.asarray(turn_action(jnp.eye(size), jnp.full(size, -turns, jnp.int32)))
            mean = self._add("MatMul", mean, back)
            log_std = self._add("MatMul", log_std, np.abs(back))  # a mirrored joint keeps its deviation
        self._add("Identity", mean, name="action")
        self._add("Identity", mean, name="mean")
        self._add("Identity", log_std, name="log_std")
        return [
            helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", size])
            for name in ("action", "mean", "log_std")
        ]

    # The quarter turn of an observation, as footwork.tasks.observe.turn_observation has it

    def _turned(self, obs: str, turns: int) -> str:
        angle = turns * np.pi / 2
        unit = jnp.eye(_LINEAR, WALKER_OBS_SIZE).at[:, 29:].set(1.0)  # no tilt, so that the rest is defined
        relabelling = np.asarray(turn_observation(unit, jnp.full(_LINEAR, turns, jnp.int32)))[:, :_LINEAR]
        linear = self._add("MatMul", self._columns(obs, 0, _LINEAR), relabelling)
        sine = [self._columns(obs, 26 + i, 27 + i) for i in range(3)]
        cosine = [self._columns(obs, 29 + i, 30 + i) for i in range(3)]
        rpy = self._rpy_about(sine, cosine, angle)
        yaw = self._atan2(sine[2], cosine[2])
        velocity = self._velocity(obs, self._add("Sub", self._add("Sub", yaw, angle), rpy[2]))
        turned = [self._add(kind, each) for kind in ("Sin", "Cos") for each in rpy]
        return self._add("Concat", linear, *velocity, rpy[0], rpy[1], *turned, axis=1)

    def _rpy_about(self, sine: list[str], cosine: list[str], angle: float) -> list[str]:
        """Roll, pitch, yaw of Rz(-angle) R Rz(angle)."""
        (sr, sp, sy), (cr, cp, cy) = sine, cosine
        rows = [
            [
                self._product(cy, cp),
                self._sum(self._product(cy, sp, sr), self._product(-1.0, sy, cr)),
                self._sum(self._product(cy, sp, cr), self._product(sy, sr)),
            ],
            [
                self._product(sy, cp),
                self._sum(self._product(sy, sp, sr), self._product(cy, cr)),
                self._sum(self._product(sy, sp, cr), self._product(-1.0, cy, sr)),
            ],
            [self._product(-1.0, sp), self._product(cp, sr), self._product(cp, cr)],
        ]
        s, c = np.float32(np.sin(angle)), np.float32(np.cos(angle))
        about = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]], np.float32)
        turned: Any = [[self._weighted(row, about[:, j]) for j in range(3)] for row in rows]
        turned = [[self._weighted([turned[i][j] for i in range(3)], about[:, k]) for j in range(3)] for k in range(3)]
        pitch = self._add("Neg", self._add("Asin", self._add("Clip", turned[2][0], -1.0, 1.0)))
        return [self._atan2(turned[2][1], turned[2][2]), pitch, self._atan2(turned[1][0], turned[0][0])]

    def _velocity(self, obs: str, angle: str) -> list[str]:
        x, y, z = (self._columns(obs, 21 + i, 22 + i) for i in range(3))
        sine, cosine = self._add("Sin", angle), self._add("Cos", angle)
        forward = self._sum(self._product(cosine, x), self._product(-1.0, sine, y))
        return [forward, self._sum(self._product(sine, x), self._product(cosine, y)), z]

    def _product(self, *factors: Any) -> str:
        result = factors[0]
        for factor in factors[1:]:
            result = self._add("Mul", result, factor)
        return result

    def _sum(self, *terms: Any) -> str:
        result = terms[0]
        for term in terms[1:]:
            result = self._add("Add", result, term)
        return result

    def _weighted(self, terms: list[str], weights: np.ndarray) -> str:
        return self._sum(*(self._product(term, float(weight)) for term, weight in zip(terms, weights, strict=True)))

    def _atan2(self, y: str, x: str) -> str:
        """ONNX has no atan2: atan(y / x), and half a turn to the side of y where x < 0."""
        positive = self._add("Less", 0.0, x)
        zero = self._add("Equal", x, 0.0)
        sign = self._add("Where", self._add("Less", y, 0.0), -1.0, 1.0)
        slope = self._add("Atan", self._add("Div", y, self._add("Where", zero, 1.0, x)))
        left = self._add("Add", slope, self._add("Mul", sign, np.pi))
        upright = self._add("Mul", self._add("Sign", y), np.pi / 2)
        return self._add("Where", zero, upright, self._add("Where", positive, slope, left))
