"""The recurrence of the sine experiment: the fused path against the same network in plain PyTorch steps."""

import numpy as np
import torch
from torch import Tensor

from neurove_core.bench import Row, interleaved
from neurove_core.spiking.alif import diffuse
from neurove_core.spiking.aslstm import ASLSTMParams, ASLSTMState, aslstm_step
from neurove_core.spiking.fused import recurrence
from neurove_core.spiking.readout import readout_step

HIDDEN, BATCH, STEPS = 51, 16, 100
V_TH = 0.3
CONSTANTS = recurrence.Constants(alpha=0.5, width=0.25)


def compare(rounds: int = 9) -> list[Row]:
    """Forward, and forward with backward, over STEPS steps at batch BATCH: two ASLSTM layers and a readout."""
    draw = np.random.default_rng(0)
    weights = _weights(draw)
    x = np.sin(np.arange(STEPS)[:, None] / 20 + draw.uniform(0, 6, BATCH)).astype(np.float32)
    state = recurrence.initial_state(BATCH, HIDDEN, np.float32)
    grad_y = draw.normal(size=x.shape).astype(np.float32)
    plain = _Plain(weights)

    def fused_both() -> None:
        tape = recurrence.forward(recurrence.ASLSTM, weights, CONSTANTS, x, state, STEPS)
        recurrence.backward(recurrence.ASLSTM, weights, CONSTANTS, tape, grad_y, STEPS)

    def plain_both() -> None:
        torch.autograd.backward(plain.run(x)[0], torch.from_numpy(grad_y))

    def plain_forward() -> None:
        with torch.no_grad():
            plain.run(x)

    times = interleaved(
        {
            "forward": lambda: recurrence.forward(recurrence.ASLSTM, weights, CONSTANTS, x, state, STEPS),
            "plain forward": plain_forward,
            "forward and backward": fused_both,
            "plain forward and backward": plain_both,
        },
        rounds,
    )
    equal = _equal(weights, plain, x, state)
    return [
        Row(
            f"sine {name}",
            times[name],
            "PyTorch, plain",
            times[f"plain {name}"],
            times[f"plain {name}"] / times[name],
            None,
            equal,
        )
        for name in ("forward", "forward and backward")
    ]


def _equal(weights: recurrence.Weights, plain: "_Plain", x: recurrence.Array, state: recurrence.State) -> bool:
    """Whether both have the same spikes, and outputs that differ only by rounding."""
    tape = recurrence.forward(recurrence.ASLSTM, weights, CONSTANTS, x, state, STEPS)
    with torch.no_grad():
        answers, spikes = plain.run(x)
    fired = np.stack([tape.first.s[1:], tape.second.s[1:]], axis=1)
    return bool(np.array_equal(fired, spikes.numpy()) and np.abs(tape.y[1:] - answers.numpy()).max() < 1e-4)


def _weights(draw: np.random.Generator) -> recurrence.Weights:
    def uniform(*shape: int) -> recurrence.Array:
        return draw.uniform(-(HIDDEN**-0.5), HIDDEN**-0.5, shape).astype(np.float32)

    def layer(inputs: int) -> recurrence.LayerWeights:
        return recurrence.LayerWeights(
            w_x=uniform(inputs, 5 * HIDDEN),
            w_r=uniform(HIDDEN, 4 * HIDDEN),
            b=uniform(5 * HIDDEN),
            d_time=np.full(HIDDEN, 0.5, np.float32),
            w_a=uniform(0, 0),
            b_a=uniform(0),
            d_space=np.full(HIDDEN, 0.5, np.float32),
            v_th=np.full(HIDDEN, V_TH, np.float32),
            s_weight=np.ones(1, np.float32),
        )

    return recurrence.Weights(layer(1), layer(HIDDEN), uniform(HIDDEN), uniform(1), np.array([0.2], np.float32))


class _Plain:
    """The same network built from `aslstm_step` and `readout_step`."""

    def __init__(self, weights: recurrence.Weights) -> None:
        def leaf(array: recurrence.Array) -> Tensor:
            return torch.tensor(array.T, requires_grad=True)

        self._layers = [(leaf(w.w_x), leaf(w.w_r), leaf(w.b), leaf(w.d_time), leaf(w.d_space)) for w in weights[:2]]
        self._out = torch.tensor(weights.w_out[None], requires_grad=True)
        self._b_out, self._kappa = leaf(weights.b_out), leaf(weights.kappa)

    def run(self, x: recurrence.Array) -> tuple[Tensor, Tensor]:
        """Outputs (T, B) and spikes (T, 2, B, H)."""
        states = [ASLSTMState(*(torch.zeros(x.shape[1], HIDDEN) for _ in range(3))) for _ in range(2)]
        y = torch.zeros(x.shape[1], 1)
        answers, spikes = [], []
        for row in torch.from_numpy(x):
            z = row[:, None]
            for k, (w_x, w_r, b, d_time, d_space) in enumerate(self._layers):
                params = ASLSTMParams(w_x, w_r, b, d_time, CONSTANTS.alpha, V_TH, "rectangular", CONSTANTS.width)
                states[k] = aslstm_step(z, states[k], params)
                z = diffuse(states[k].s, states[k].v, d_space)
            y = readout_step(z, y, self._out, self._b_out, self._kappa)
            answers.append(y[:, 0])
            spikes.append(torch.stack([state.s for state in states]))
        return torch.stack(answers), torch.stack(spikes)
