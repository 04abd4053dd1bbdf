"""The fused path of a two-layer spiking recurrent network: a whole sequence forward and backward in machine code.

The network is the one of the paper's regression experiment: two layers of cells (ASLSTM, SLSTM or LTC), a leaky
readout, one number in and one out per step; or in a closed loop, where the answer is the next input. `cells.py` and
`neurons.py` hold the plain form of each layer; tests compare answers, spikes and, in float64, every gradient with
autograd through it.

Layouts: B rows of a batch, T steps, H units, I inputs, G = 5H (ASLSTM: input, forget, cell, output gate, f), 4H (SLSTM:
the gates) or H (LTC: d). All arrays are contiguous and of one type, float32 or float64.
"""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.activations import fused as _fused
from neurove_core.activations import sigmoid as _sigmoid
from neurove_core.activations import tanh as _tanh

ASLSTM: Final = 0
SLSTM: Final = 1
LTC: Final = 2

Array = NDArray[Any]  # float32 or float64


class LayerWeights(NamedTuple):
    """One layer; what its kind does not use is of size 0."""

    w_x: Array  # (I, G) from the input
    w_r: Array  # (H, 4H) from the potential to the gates; LTC: (H, H) from the spikes
    b: Array  # (G)
    d_time: Array  # (H) ASLSTM: diffusion from the same neuron one step ago
    w_a: Array  # (2H, H) LTC: from (d, m) to the time constants
    b_a: Array  # (H) LTC
    d_space: Array  # (H) diffusion to what is above: z = s_weight * s + d_space * v
    v_th: Array  # (H) firing thresholds
    s_weight: Array  # (1) 1 where spikes go up, 0 where only potentials do; not learned, its gradient stays 0


class Weights(NamedTuple):
    """The network."""

    first: LayerWeights
    second: LayerWeights
    w_out: Array  # (H)
    b_out: Array  # (1)
    kappa: Array  # (1) leak of the readout


class Constants(NamedTuple):
    """What is not learned."""

    alpha: float  # ASLSTM: share of h in the potential
    width: float  # of the rectangular surrogate, in units of the potential
    damping: float = 1.0  # area under the surrogate; below 1 gradients through many spikes die out instead of exploding


class LayerState(NamedTuple):
    """What a layer carries: c is unused by LTC, whose v is m."""

    c: Array  # (B, H)
    v: Array  # (B, H)
    s: Array  # (B, H)


class State(NamedTuple):
    """What the network carries."""

    first: LayerState
    second: LayerState
    y: Array  # (B)


class LayerTape(NamedTuple):
    """What a layer's forward pass leaves for its backward pass; row t of c, v, s is the state before step t."""

    u: Array  # (T, B, I) input
    gates: Array  # (T, B, G) activations: sigmoid and tanh taken; ASLSTM's last H are f; LTC: d
    q: Array  # (T, B, 4H) scratch of the recurrent product; LTC: (T, B, 2H) is (d, m')
    c: Array  # (T + 1, B, H)
    tc: Array  # (T, B, H) tanh(c); LTC: a
    v: Array  # (T + 1, B, H); LTC: m after the reset
    pre: Array  # (T, B, H) potential that is compared with the threshold
    s: Array  # (T + 1, B, H)
    z: Array  # (T, B, H) what goes up


class Tape(NamedTuple):
    """A forward pass."""

    first: LayerTape
    second: LayerTape
    y: Array  # (T + 1, B): row 0 is the state before


def weights_like(weights: Weights) -> Weights:
    """Zeros in the shape of some weights: gradients are gathered in these."""
    first, second = (LayerWeights(*(np.zeros_like(array) for array in layer)) for layer in weights[:2])
    return Weights(first, second, *(np.zeros_like(array) for array in weights[2:]))


def initial_state(batch: int, hidden: int, dtype: Any) -> State:
    """Everything at rest."""

    def zeros() -> Array:
        return np.zeros((batch, hidden), dtype)

    return State(LayerState(zeros(), zeros(), zeros()), LayerState(zeros(), zeros(), zeros()), np.zeros(batch, dtype))


def forward(kind: int, weights: Weights, constants: Constants, x: Array, state: State, free_from: int) -> Tape:
    """Run the network over a sequence.

    Args:
        kind: ASLSTM, SLSTM or LTC.
        weights: of the network.
        constants: alpha, surrogate width.
        x: (T, B) inputs; from step `free_from` on they are not read.
        state: before the first step.
        free_from: from this step on the input is the answer of the step before; T for none, at least 1.

    Returns:
        the tape: its y[1:] are the answers, (T, B).
    """
    steps, batch = x.shape
    tape = Tape(
        _layer_tape(kind, weights.first, state.first, steps, batch),
        _layer_tape(kind, weights.second, state.second, steps, batch),
        np.empty((steps + 1, batch), x.dtype),
    )
    tape.y[0] = state.y
    _forward(kind, weights, _typed(constants, x.dtype), x, tape, free_from, x.dtype == np.float32)
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
    """Gradients of all weights; the state before the first step is taken as given.

    Args:
        kind: as in forward.
        weights: as in forward.
        constants: as in forward.
        tape: of forward; used up by this call.
        grad_y: (T, B) gradient of the loss by the answers.
        free_from: as in forward.
        grad_s: gradient of the loss by each single spike of the first and of the second layer, as of a rate.
    """
    grads = weights_like(weights)
    pull = np.array(grad_s, grad_y.dtype)
    _backward(kind, weights, _typed(constants, grad_y.dtype), tape, grad_y.copy(), grads, free_from, pull)
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


@_fused
def _lstm_step(kind, w, constants, tape, t, fast):  # type: ignore[no-untyped-def]  # compiled for its arguments
    batch, hidden = tape.tc.shape[1:]
    one = w.b.dtype.type(1)
    gates, q = tape.gates[t], tape.q[t]
    if tape.u.shape[2] == 1:
        for b in range(batch):
            x = tape.u[t, b, 0]
            for j in range(gates.shape[1]):
                gates[b, j] = x * w.w_x[0, j] + w.b[j]
    else:
        np.dot(tape.u[t], w.w_x, gates)
        for b in range(batch):
            for j in range(gates.shape[1]):
                gates[b, j] += w.b[j]
    np.dot(tape.v[t], w.w_r, q)
    # three of the four gates are sigmoids and the cell gate a tanh, which is 2 sigmoid(2 x) - 1: one pass for all
    for b in range(batch):
        for j in range(4 * hidden):
            q[b, j] += gates[b, j]
        for j in range(2 * hidden, 3 * hidden):
            q[b, j] += q[b, j]
    _sigmoid(q, one, fast)
    for b in range(batch):
        for j in range(2 * hidden):
            gates[b, j] = q[b, j]
        for j in range(2 * hidden, 3 * hidden):
            gates[b, j] = q[b, j] + q[b, j] - one
        for j in range(3 * hidden, 4 * hidden):
            gates[b, j] = q[b, j]
    c, tc = tape.c[t + 1], tape.tc[t]
    for b in range(batch):
        for j in range(hidden):
            c[b, j] = gates[b, hidden + j] * tape.c[t, b, j] + gates[b, j] * gates[b, 2 * hidden + j]
            tc[b, j] = c[b, j]
    _tanh(tc, fast)
    for b in range(batch):
        for j in range(hidden):
            h = gates[b, 3 * hidden + j] * tc[b, j]
            if kind == ASLSTM:
                v = constants.alpha * (one - tape.s[t, b, j]) * h + gates[b, 4 * hidden + j]
                v += w.d_time[j] * tape.v[t, b, j]
            else:
                v = h - w.v_th[j] * tape.s[t, b, j]
            tape.pre[t, b, j] = v
            tape.v[t + 1, b, j] = v


@_fused
def _ltc_step(w, tape, t, fast):  # type: ignore[no-untyped-def]  # compiled for its arguments
    batch, hidden = tape.tc.shape[1:]
    one = w.b.dtype.type(1)
    d, cat, a = tape.gates[t], tape.q[t], tape.tc[t]
    np.dot(tape.s[t], w.w_r, d)
    for b in range(batch):
        for j in range(hidden):
            d[b, j] += w.b[j]
    if tape.u.shape[2] == 1:
        for b in range(batch):
            x = tape.u[t, b, 0]
            for j in range(hidden):
                d[b, j] += x * w.w_x[0, j]
    else:
        np.dot(tape.u[t], w.w_x, a)
        for b in range(batch):
            for j in range(hidden):
                d[b, j] += a[b, j]
    for b in range(batch):
        for j in range(hidden):
            cat[b, j] = d[b, j]
            cat[b, hidden + j] = tape.v[t, b, j]
    np.dot(cat, w.w_a, a)
    for b in range(batch):
        for j in range(hidden):
            a[b, j] += w.b_a[j]
    _sigmoid(a, one, fast)
    for b in range(batch):
        for j in range(hidden):
            m = tape.v[t, b, j]
            tape.pre[t, b, j] = m + (d[b, j] - m) * a[b, j]


@_fused
def _layer_step(kind, w, constants, tape, t, fast):  # type: ignore[no-untyped-def]  # compiled for its arguments
    batch, hidden = tape.tc.shape[1:]
    one, none = w.b.dtype.type(1), w.b.dtype.type(0)
    if kind == LTC:
        _ltc_step(w, tape, t, fast)
    else:
        _lstm_step(kind, w, constants, tape, t, fast)
    for b in range(batch):
        for j in range(hidden):
            v = tape.pre[t, b, j]
            s = one if v >= w.v_th[j] else none
            tape.s[t + 1, b, j] = s
            if kind == LTC:
                tape.v[t + 1, b, j] = v * (one - s)
            tape.z[t, b, j] = w.s_weight[0] * s + w.d_space[j] * tape.v[t + 1, b, j]


@_fused
def _forward(kind, weights, constants, x, tape, free_from, fast):  # type: ignore[no-untyped-def]  # as above
    steps, batch = x.shape
    for t in range(steps):
        for b in range(batch):
            tape.first.u[t, b, 0] = x[t, b] if t < free_from else tape.y[t, b]
        _layer_step(kind, weights.first, constants, tape.first, t, fast)
        tape.second.u[t] = tape.first.z[t]
        _layer_step(kind, weights.second, constants, tape.second, t, fast)
        for b in range(batch):
            y = weights.kappa[0] * tape.y[t, b] + weights.b_out[0]
            for j in range(weights.w_out.size):
                y += weights.w_out[j] * tape.second.z[t, b, j]
            tape.y[t + 1, b] = y


class _Carry(NamedTuple):
    """Gradients on their way back from step t + 1 to step t."""

    c: Array
    v: Array
    s: Array


@_fused
def _layer_back(kind, w, w_x_t, w_r_t, w_a_t, constants, tape, t, dz, carry, du, dq, grads, pull):  # type: ignore[no-untyped-def]  # as above
    """Gradient of one step of one layer: from dz of what went up to du of its input.

    What the weights' gradients are made of stays in the tape (gates and q): one large product gathers it at the end.
    """
    batch, hidden = tape.tc.shape[1:]
    one, none = w.b.dtype.type(1), w.b.dtype.type(0)
    half, height = constants.width / w.b.dtype.type(2), constants.damping / constants.width
    gates = tape.gates[t]
    for b in range(batch):
        for j in range(hidden):
            s = tape.s[t + 1, b, j]
            grads.d_space[j] += dz[b, j] * tape.v[t + 1, b, j]
            ds = w.s_weight[0] * dz[b, j] + carry.s[b, j] + pull
            from_spike = ds * height if abs(tape.pre[t, b, j] - w.v_th[j]) < half else none
            grads.v_th[j] -= from_spike
            dv = carry.v[b, j] + w.d_space[j] * dz[b, j]
            if kind == LTC:
                dm = dv * (one - s) + from_spike
                d, a, m = gates[b, j], tape.tc[t, b, j], tape.v[t, b, j]
                tape.pre[t, b, j] = dm * (d - m) * a * (one - a)  # of the time constant's argument
                gates[b, j] = dm * a
                carry.v[b, j] = dm * (one - a)
                continue
            dv += from_spike
            i, f = gates[b, j], gates[b, hidden + j]
            g, o = gates[b, 2 * hidden + j], gates[b, 3 * hidden + j]
            tc = tape.tc[t, b, j]
            dh = dv
            carry.v[b, j] = none
            if kind == ASLSTM:
                gates[b, 4 * hidden + j] = dv
                grads.d_time[j] += dv * tape.v[t, b, j]
                carry.v[b, j] = dv * w.d_time[j]
                dh = constants.alpha * (one - tape.s[t, b, j]) * dv
            else:
                grads.v_th[j] -= dv * tape.s[t, b, j]
            dc = carry.c[b, j] + dh * o * (one - tc * tc)
            gates[b, j] = dc * g * i * (one - i)
            gates[b, hidden + j] = dc * tape.c[t, b, j] * f * (one - f)
            gates[b, 2 * hidden + j] = dc * i * (one - g * g)
            gates[b, 3 * hidden + j] = dh * tc * o * (one - o)
            carry.c[b, j] = dc * f
            carry.s[b, j] = none
    if kind == LTC:
        dcat = dq
        np.dot(tape.pre[t], w_a_t, dcat)
        for b in range(batch):
            for j in range(hidden):
                gates[b, j] += dcat[b, j]
                carry.v[b, j] += dcat[b, hidden + j]
        np.dot(gates, w_r_t, carry.s)
    else:
        for b in range(batch):
            for j in range(4 * hidden):
                dq[b, j] = gates[b, j]
        dv_before = tape.pre[t]  # its values are used up: room for the product
        np.dot(dq, w_r_t, dv_before)
        for b in range(batch):
            for j in range(hidden):
                carry.v[b, j] += dv_before[b, j]
    np.dot(gates, w_x_t, du)


@_fused
def _gather(kind, tape, grads):  # type: ignore[no-untyped-def]  # as above
    """Weight gradients of a layer over all steps and rows at once."""
    steps, batch, inputs = tape.u.shape
    hidden = tape.tc.shape[2]
    rows = steps * batch
    gates = tape.gates.reshape(rows, tape.gates.shape[2])
    grads.w_x[:] = np.dot(np.ascontiguousarray(tape.u.reshape(rows, inputs).T), gates)
    for r in range(rows):
        for j in range(gates.shape[1]):
            grads.b[j] += gates[r, j]
    if kind == LTC:
        before = tape.s[:steps].copy().reshape(rows, hidden)
        grads.w_r[:] = np.dot(np.ascontiguousarray(before.T), gates)
        da = tape.pre.reshape(rows, hidden)
        grads.w_a[:] = np.dot(np.ascontiguousarray(tape.q.reshape(rows, 2 * hidden).T), da)
        for r in range(rows):
            for j in range(hidden):
                grads.b_a[j] += da[r, j]
    else:
        before = tape.v[:steps].copy().reshape(rows, hidden)
        grads.w_r[:] = np.dot(np.ascontiguousarray(before.T), np.ascontiguousarray(gates[:, : 4 * hidden]))


@_fused
def _carry(batch, hidden, like):  # type: ignore[no-untyped-def]  # as above
    return _Carry(
        np.zeros((batch, hidden), like.dtype),
        np.zeros((batch, hidden), like.dtype),
        np.zeros((batch, hidden), like.dtype),
    )


@_fused
def _backward(kind, weights, constants, tape, grad_y, grads, free_from, pull):  # type: ignore[no-untyped-def]  # as above
    steps, batch = grad_y.shape
    hidden = weights.w_out.size
    first, second = weights.first, weights.second
    x1, r1, a1 = first.w_x.T.copy(), first.w_r.T.copy(), first.w_a.T.copy()
    x2, r2, a2 = second.w_x.T.copy(), second.w_r.T.copy(), second.w_a.T.copy()
    carry1, carry2 = _carry(batch, hidden, grad_y), _carry(batch, hidden, grad_y)
    dz2 = np.zeros((batch, hidden), grad_y.dtype)
    dz1 = np.zeros((batch, hidden), grad_y.dtype)
    dx = np.zeros((batch, 1), grad_y.dtype)
    dq = np.zeros((batch, tape.first.q.shape[2]), grad_y.dtype)
    for t in range(steps - 1, -1, -1):
        for b in range(batch):
            dy = grad_y[t, b]
            if t + 1 < steps:
                dy += weights.kappa[0] * grad_y[t + 1, b]
                if t + 1 >= free_from:
                    dy += dx[b, 0]
            grad_y[t, b] = dy
            grads.b_out[0] += dy
            grads.kappa[0] += dy * tape.y[t, b]
            for j in range(hidden):
                grads.w_out[j] += dy * tape.second.z[t, b, j]
                dz2[b, j] = dy * weights.w_out[j]
        _layer_back(kind, second, x2, r2, a2, constants, tape.second, t, dz2, carry2, dz1, dq, grads.second, pull[1])
        _layer_back(kind, first, x1, r1, a1, constants, tape.first, t, dz1, carry1, dx, dq, grads.first, pull[0])
    _gather(kind, tape.first, grads.first)
    _gather(kind, tape.second, grads.second)
