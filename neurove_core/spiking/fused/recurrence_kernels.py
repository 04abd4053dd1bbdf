"""Compiled kernels of recurrence.py: steps of the layers, forward and backward. recurrence.py explains the layouts.

numba compiles them at first use for the types of the arguments and caches them on disk.
"""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.spiking.fused.activations import fused, sigmoid, tanh

ASLSTM: Final = 0
SLSTM: Final = 1
LTC: Final = 2

Array = NDArray[Any]  # float32 or float64


@fused
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
    # three gates are sigmoids, the cell gate is a tanh, which is 2 sigmoid(2 x) - 1: one pass for all four
    for b in range(batch):
        for j in range(4 * hidden):
            q[b, j] += gates[b, j]
        for j in range(2 * hidden, 3 * hidden):
            q[b, j] += q[b, j]
    sigmoid(q, one, fast)
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
    tanh(tc, fast)
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


@fused
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
    sigmoid(a, one, fast)
    for b in range(batch):
        for j in range(hidden):
            m = tape.v[t, b, j]
            tape.pre[t, b, j] = m + (d[b, j] - m) * a[b, j]


@fused
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


@fused
def forward_steps(kind, weights, constants, x, tape, free_from, fast):  # type: ignore[no-untyped-def]  # as above
    """Fill the tape from its row 0; see `recurrence.forward`."""
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
    """Gradients that flow from step t + 1 back to step t."""

    c: Array
    v: Array
    s: Array


@fused
def _layer_back(kind, w, w_x_t, w_r_t, w_a_t, constants, tape, t, dz, carry, du, dq, grads, pull):  # type: ignore[no-untyped-def]  # as above
    """Gradient of one step of one layer, from dz of its output to du of its input.

    The terms of the weights' gradients stay in the tape (gates and q); `_gather` sums them with one large product.
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
                tape.pre[t, b, j] = dm * (d - m) * a * (one - a)  # gradient of the time constant's argument
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
        dv_before = tape.pre[t]  # its values are no longer needed: memory for the product
        np.dot(dq, w_r_t, dv_before)
        for b in range(batch):
            for j in range(hidden):
                carry.v[b, j] += dv_before[b, j]
    np.dot(gates, w_x_t, du)


@fused
def _gather(kind, tape, grads):  # type: ignore[no-untyped-def]  # as above
    """Weight gradients of a layer, over all steps and rows at once."""
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


@fused
def _carry(batch, hidden, like):  # type: ignore[no-untyped-def]  # as above
    return _Carry(
        np.zeros((batch, hidden), like.dtype),
        np.zeros((batch, hidden), like.dtype),
        np.zeros((batch, hidden), like.dtype),
    )


@fused
def backward_steps(kind, weights, constants, tape, grad_y, grads, free_from, pull):  # type: ignore[no-untyped-def]  # as above
    """Add up the gradients from the tape's last step to its first; see `recurrence.backward`."""
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
