"""Compiled forward and backward pass of a two-layer spiking recurrent network over a whole sequence.

The network is that of the paper's regression experiment: two layers of cells (ASLSTM, SLSTM or LTC), a leaky readout,
one number in and one out per step, or a closed loop, where the output is the next input. The reference implementation
of each layer is in `aslstm.py`, `slstm.py` and `ltc.py`; tests compare outputs, spikes and, in float64, every gradient
with autograd through it.

Layouts: B batch, T steps, H units, I inputs, G = 5H (ASLSTM: input, forget, cell, output gate, f), 4H (SLSTM: the
gates) or H (LTC: d). All arrays are contiguous and of one type, float32 or float64.
"""

from typing import Any, NamedTuple

import numpy as np

from neurove_core.spiking.fused.recurrence_kernels import ASLSTM, LTC, SLSTM, Array, backward_steps, forward_steps

__all__ = [
    "ASLSTM",
    "LTC",
    "SLSTM",
    "Array",
    "Constants",
    "LayerState",
    "LayerTape",
    "LayerWeights",
    "State",
    "Tape",
    "Weights",
    "backward",
    "forward",
    "initial_state",
    "state_after",
    "weights_like",
]


class LayerWeights(NamedTuple):
    """Weights of one layer; arrays that its kind does not use have size 0."""

    w_x: Array  # (I, G) from the input
    w_r: Array  # (H, 4H) from the potential to the gates; LTC: (H, H) from the spikes
    b: Array  # (G)
    d_time: Array  # (H) ASLSTM: diffusion from the same neuron one step ago
    w_a: Array  # (2H, H) LTC: from (d, m) to the time constants
    b_a: Array  # (H) LTC
    d_space: Array  # (H) diffusion to the next layer: z = s_weight * s + d_space * v
    v_th: Array  # (H) firing thresholds
    s_weight: Array  # (1) 1 where spikes go to the next layer, 0 where only potentials do; not learned, gradient 0


class Weights(NamedTuple):
    """Weights of the network."""

    first: LayerWeights
    second: LayerWeights
    w_out: Array  # (H)
    b_out: Array  # (1)
    kappa: Array  # (1) leak of the readout


class Constants(NamedTuple):
    """Constants that are not learned."""

    alpha: float  # ASLSTM: share of h in the potential
    width: float  # width of the rectangular surrogate, in units of the potential
    damping: float = 1.0  # area under the surrogate; below 1, gradients through many spikes vanish instead of exploding


class LayerState(NamedTuple):
    """State of a layer; LTC does not use c, and its v is m."""

    c: Array  # (B, H)
    v: Array  # (B, H)
    s: Array  # (B, H)


class State(NamedTuple):
    """State of the network."""

    first: LayerState
    second: LayerState
    y: Array  # (B)


class LayerTape(NamedTuple):
    """Values of a layer's forward pass for the backward pass; row t of c, v, s is the state before step t."""

    u: Array  # (T, B, I) input
    gates: Array  # (T, B, G) gates after sigmoid and tanh; ASLSTM's last H are f; LTC: d
    q: Array  # (T, B, 4H) scratch of the recurrent product; LTC: (T, B, 2H) is (d, m')
    c: Array  # (T + 1, B, H)
    tc: Array  # (T, B, H) tanh(c); LTC: a
    v: Array  # (T + 1, B, H); LTC: m after the reset
    pre: Array  # (T, B, H) potential before the reset
    s: Array  # (T + 1, B, H)
    z: Array  # (T, B, H) output to the next layer


class Tape(NamedTuple):
    """Values of a forward pass."""

    first: LayerTape
    second: LayerTape
    y: Array  # (T + 1, B): row 0 is the state before


def weights_like(weights: Weights) -> Weights:
    """Zeros in the shape of some weights, for their gradients."""
    first, second = (LayerWeights(*(np.zeros_like(array) for array in layer)) for layer in weights[:2])
    return Weights(first, second, *(np.zeros_like(array) for array in weights[2:]))


def initial_state(batch: int, hidden: int, dtype: Any) -> State:
    """The zero state."""

    def zeros() -> Array:
        return np.zeros((batch, hidden), dtype)

    return State(LayerState(zeros(), zeros(), zeros()), LayerState(zeros(), zeros(), zeros()), np.zeros(batch, dtype))


def forward(kind: int, weights: Weights, constants: Constants, x: Array, state: State, free_from: int) -> Tape:
    """Run the network over a sequence.

    Args:
        kind: ASLSTM, SLSTM or LTC.
        weights: weights of the network.
        constants: alpha, surrogate width.
        x: (T, B) inputs; not read from step `free_from` on.
        state: state before the first step.
        free_from: from this step on, at least 1, the input is the previous output; T for an open loop.

    Returns:
        the tape; its y[1:] are the outputs, (T, B).
    """
    steps, batch = x.shape
    tape = Tape(
        _layer_tape(kind, weights.first, state.first, steps, batch),
        _layer_tape(kind, weights.second, state.second, steps, batch),
        np.empty((steps + 1, batch), x.dtype),
    )
    tape.y[0] = state.y
    forward_steps(kind, weights, _typed(constants, x.dtype), x, tape, free_from, x.dtype == np.float32)
    return tape


def backward(
    kind: int,
    weights: Weights,
    constants: Constants,
    tape: Tape,
    grad_y: Array,
    free_from: int,
    grad_s: tuple[float, float] = (0.0, 0.0),
) -> Weights:
    """Gradients of all weights; the initial state is a constant.

    Args:
        kind: as in forward.
        weights: as in forward.
        constants: as in forward.
        tape: from forward; overwritten by this call.
        grad_y: (T, B) gradient of the loss with respect to the outputs.
        free_from: as in forward.
        grad_s: gradient of the loss with respect to each spike of the first and of the second layer, such as that of a
            firing rate.
    """
    grads = weights_like(weights)
    pull = np.array(grad_s, grad_y.dtype)
    backward_steps(kind, weights, _typed(constants, grad_y.dtype), tape, grad_y.copy(), grads, free_from, pull)
    return grads


def state_after(tape: Tape, step: int) -> State:
    """A copy of the state after `step` steps of a tape."""
    first, second = (LayerState(layer.c[step].copy(), layer.v[step].copy(), layer.s[step].copy()) for layer in tape[:2])
    return State(first, second, tape.y[step].copy())


def _typed(constants: Constants, dtype: Any) -> Constants:
    return Constants(*(np.dtype(dtype).type(value) for value in constants))


def _layer_tape(kind: int, weights: LayerWeights, state: LayerState, steps: int, batch: int) -> LayerTape:
    inputs, gates = weights.w_x.shape
    hidden, dtype = state.v.shape[1], weights.w_x.dtype

    def empty(*shape: int) -> Array:
        return np.empty(shape, dtype)

    tape = LayerTape(
        u=empty(steps, batch, inputs),
        gates=empty(steps, batch, gates),
        q=empty(steps, batch, (2 if kind == LTC else 4) * hidden),
        c=empty(steps + 1, batch, hidden),
        tc=empty(steps, batch, hidden),
        v=empty(steps + 1, batch, hidden),
        pre=empty(steps, batch, hidden),
        s=empty(steps + 1, batch, hidden),
        z=empty(steps, batch, hidden),
    )
    tape.c[0], tape.v[0], tape.s[0] = state
    return tape
