"""A layer of ASLSTM cells over all its time steps, with one node of the autograd graph: `aslstm.ASLSTM` on a CPU.

Plain PyTorch records about twenty operations for each step, and adds each step's gradients of the weights to the sum.
Here the forward pass records nothing. The backward pass goes through the steps once, in compiled code around the one
product that depends on the step after it, and computes all other products for all steps at once.

The forward pass makes the same calls of PyTorch, or rounds in the same places, so that all states equal those of
`aslstm.aslstm_step` bit for bit where N is a multiple of 16 (for other widths PyTorch's own products and functions
round by the address of their arguments). Gradients are equal up to rounding. Tests compare both.
"""

from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import linear

from neurove_core.compiled import compiled
from neurove_core.spiking.surrogate import Surrogate, surrogate_gradient

Array = NDArray[Any]  # float32 or float64

States = tuple[Tensor, Tensor, Tensor]


def fits(x: Tensor, *others: Tensor) -> bool:
    """Whether the layer is computed here: gradients are recorded, on the CPU, all float32 or float64, not empty."""
    return (
        torch.is_grad_enabled()
        and not torch.is_autocast_enabled("cpu")
        and x.dtype in (torch.float32, torch.float64)
        and x.numel() > 0
        and all(other.dtype == x.dtype for other in others)
        and all(one.device.type == "cpu" for one in (x, *others))
    )


def scan(
    x: Tensor, state: States, weights: tuple[Tensor, Tensor, Tensor, Tensor], alpha: float, spike: tuple[Any, ...]
) -> States:
    """A layer over a sequence.

    Args:
        x: input (T, B, I), accepted by `fits`.
        state: c, v and s (B, N) before the first step.
        weights: w_x (5N, I), w_v (4N, N), b (5N) and d_time (N); see ASLSTMParams.
        alpha: share of h in the potential.
        spike: threshold, kind and width of the surrogate.

    Returns:
        c, v and s (T, B, N) after each step.
    """
    return _Layer.apply(x, *state, *weights, alpha, *spike)  # type: ignore[no-any-return, no-untyped-call]  # torch types apply as Any


class _Layer(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        c: Tensor,
        v: Tensor,
        s: Tensor,
        w_x: Tensor,
        w_v: Tensor,
        b: Tensor,
        d_time: Tensor,
        alpha: float,
        v_th: float,
        surrogate: Surrogate,
        width: float,
    ) -> States:  # torch's own type
        (steps, batch), n = x.shape[:2], c.shape[1]
        cs, vs, ss = states = x.new_empty(3, steps + 1, batch, n)  # row t is the state before step t
        cs[0], vs[0], ss[0] = c, v, s
        gates, tanh_c = x.new_empty(steps, batch, 4 * n), x.new_empty(steps, batch, n)
        cells, given = states.numpy(), (gates.numpy(), tanh_c.numpy(), d_time.detach().numpy())
        kind = cells.dtype.type
        for t in range(steps):
            from_x = linear(x[t], w_x, b)
            into, out = (from_x[:, : 4 * n] + linear(vs[t], w_v)).chunk(4, dim=1), gates[t].chunk(4, dim=1)
            for gate, activation in enumerate((torch.sigmoid, torch.sigmoid, torch.tanh, torch.sigmoid)):
                activation(into[gate], out=out[gate])
            _remember(t, gates.numpy(), cells[0])
            torch.tanh(cs[t + 1], out=tanh_c[t])
            _fire(t, *given, from_x.numpy(), cells, kind(alpha), kind(v_th))
        ctx.save_for_backward(x, states, gates, tanh_c, w_x, w_v, d_time)
        ctx.constants = alpha, v_th, surrogate, width
        return cs[1:], vs[1:], ss[1:]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:  # torch's own type
        x, states, gates, tanh_c, w_x, w_v, d_time = ctx.saved_tensors
        alpha, v_th, surrogate, width = ctx.constants
        steps, batch, n = tanh_c.shape
        vs = states[1]
        by_c, by_v = grads[0], grads[1] + grads[2] * surrogate_gradient(vs[1:] - v_th, surrogate, width)
        by_sums = x.new_empty(steps, batch, 5 * n)  # gradients of the gates before sigmoid and tanh, and of f
        carried_c, carried_v = x.new_zeros(batch, n), x.new_zeros(batch, n)
        pulled = x.new_zeros(batch, n)
        taped = gates.numpy(), tanh_c.numpy(), states.numpy(), by_c.contiguous().numpy(), by_v.contiguous().numpy()
        constants = d_time.numpy(), states.numpy().dtype.type(alpha)
        given: Any = *taped, *constants, carried_c.numpy(), carried_v.numpy(), pulled.numpy(), by_sums.numpy()
        for t in range(steps - 1, -1, -1):
            _back(t, *given)
            torch.mm(by_sums[t, :, : 4 * n], w_v, out=pulled)
        carried_v += pulled
        rows, before = by_sums.flatten(0, 1), vs[:-1].flatten(0, 1)
        by_x = (rows @ w_x).unflatten(0, (steps, batch)) if ctx.needs_input_grad[0] else None
        by_w_x, by_w_v = rows.t() @ x.flatten(0, 1), rows[:, : 4 * n].t() @ before
        by_leak = (rows[:, 4 * n :] * before).sum(0) if ctx.needs_input_grad[7] else None
        return by_x, carried_c, carried_v, None, by_w_x, by_w_v, rows.sum(0), by_leak, None, None, None, None


@compiled
def _remember(t: int, gates: Array, cs: Array) -> None:  # pragma: no cover (machine code)
    """Long-term memory after step t."""
    batch, n = cs.shape[1:]
    for row in range(batch):
        gate, before, after = gates[t, row], cs[t, row], cs[t + 1, row]
        for j in range(n):
            after[j] = gate[n + j] * before[j] + gate[j] * gate[2 * n + j]


@compiled
def _fire(
    t: int, gates: Array, tanh_c: Array, d_time: Array, from_x: Array, states: Array, alpha: Any, v_th: Any
) -> None:  # pragma: no cover (machine code)
    """Potentials and spikes of step t."""
    batch, n = tanh_c.shape[1:]
    one, none = states.dtype.type(1), states.dtype.type(0)
    for row in range(batch):
        gate, tanh, own = gates[t, row, 3 * n :], tanh_c[t, row], from_x[row, 4 * n :]
        v, s = states[1, t, row], states[2, t, row]
        v_after, s_after = states[1, t + 1, row], states[2, t + 1, row]
        for j in range(n):
            h = gate[j] * tanh[j]
            u = alpha * (one - s[j]) * h + own[j] + d_time[j] * v[j]
            v_after[j] = u
            s_after[j] = one if u - v_th >= none else none


@compiled
def _back(
    t: int,
    gates: Array,
    tanh_c: Array,
    states: Array,
    by_c: Array,
    by_v: Array,
    d_time: Array,
    alpha: Any,
    carried_c: Array,
    carried_v: Array,
    pulled: Array,
    by_sums: Array,
) -> None:  # pragma: no cover (machine code)
    """Gradients of the sums of step t; `pulled` is that of its potential through the gates of the step after."""
    batch, n = tanh_c.shape[1:]
    one = states.dtype.type(1)
    for row in range(batch):
        gate, tanh, before, fired = gates[t, row], tanh_c[t, row], states[0, t, row], states[2, t, row]
        out, to_c, to_v = by_sums[t, row], carried_c[row], carried_v[row]
        for j in range(n):
            i, f, g, o = gate[j], gate[n + j], gate[2 * n + j], gate[3 * n + j]
            dv = by_v[t, row, j] + to_v[j] + pulled[row, j]
            dh = dv * alpha * (one - fired[j])
            dc = by_c[t, row, j] + to_c[j] + dh * o * (one - tanh[j] * tanh[j])
            out[j] = dc * g * i * (one - i)
            out[n + j] = dc * before[j] * f * (one - f)
            out[2 * n + j] = dc * i * (one - g * g)
            out[3 * n + j] = dh * tanh[j] * o * (one - o)
            out[4 * n + j] = dv
            to_c[j] = dc * f
            to_v[j] = dv * d_time[j]


def leaky_sums(inputs: Tensor, y: Tensor, kappa: Tensor) -> Tensor:
    """Potentials y = kappa y' + input of each step, with one node of the autograd graph.

    Args:
        inputs: (T, B, K), accepted by `fits`.
        y: potentials before the first step (B, K).
        kappa: leak per step, one number.

    Returns:
        (T, B, K), equal to those of `readout.readout_step` bit for bit.
    """
    return _LeakySums.apply(inputs, y, kappa)  # type: ignore[no-any-return, no-untyped-call]  # torch types apply as Any


class _LeakySums(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, inputs: Tensor, y: Tensor, kappa: Tensor) -> Tensor:  # torch's own type
        answers = torch.cat([y[None], inputs])
        _add_leaking(answers.numpy(), answers.numpy().dtype.type(kappa.item()))
        ctx.save_for_backward(answers, kappa)
        return answers[1:]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor, Tensor]:  # torch's own type
        answers, kappa = ctx.saved_tensors
        total = torch.cat([grads[0], torch.zeros_like(grads[0][:1])]).flip(0)
        _add_leaking(total.numpy(), total.numpy().dtype.type(kappa.item()))
        total = total.flip(0)[:-1]
        return total, kappa * total[0], (total * answers[:-1]).sum()


@compiled
def _add_leaking(values: Array, kappa: Any) -> None:  # pragma: no cover (machine code)
    """Add to each row kappa times the row before it."""
    for t in range(1, values.shape[0]):
        for row in range(values.shape[1]):
            for j in range(values.shape[2]):
                values[t, row, j] = kappa * values[t - 1, row, j] + values[t, row, j]


def applied(z: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """The linear map of each step (T, B, N) to (T, B, K), with one node of the autograd graph.

    The forward pass computes step by step, because a product of more rows may round otherwise.
    """
    return _Applied.apply(z, weight, bias)  # type: ignore[no-any-return, no-untyped-call]  # torch types apply as Any


class _Applied(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, z: Tensor, weight: Tensor, bias: Tensor) -> Tensor:  # torch's own type
        ctx.save_for_backward(z, weight)
        return torch.stack([linear(one, weight, bias) for one in z])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor, Tensor]:  # torch's own type
        z, weight = ctx.saved_tensors
        rows = grads[0].flatten(0, 1)
        return (rows @ weight).view_as(z), rows.t() @ z.flatten(0, 1), rows.sum(0)
