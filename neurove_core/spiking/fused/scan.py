"""A population of LIF neurons over all its time steps in one compiled pass: `lif.lif_scan` on a CPU.

Plain PyTorch moves every membrane potential to memory and back about ten times per step. Here a block of neurons stays
in the cache for all T steps, currents are read once and spikes are written once. For the backward pass the rectangular
surrogate stores one byte per neuron and step, any other surrogate the distance of the potential from the threshold.
`lif.lif_scan_reference` is the reference implementation; tests compare spikes and potentials bit for bit, and the
gradients.
"""

import math
from collections.abc import Callable
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from neurove_core.compiled import compiled
from neurove_core.spiking.surrogate import Surrogate

Array = NDArray[Any]  # float32 or float64

FIRED: Final = 1  # bit of a code: the neuron fired in this step
NEAR: Final = 2  # bit of a code: its potential was within the surrogate's width

_BLOCK: Final = 1024  # neurons whose potentials stay in the first-level cache over all steps


def fits(currents: Tensor, v: Tensor) -> bool:
    """Whether the compiled scan accepts these: on the CPU, both float32 or float64, not empty, of matching shapes."""
    return (
        currents.device.type == "cpu"
        and currents.dtype in (torch.float32, torch.float64)
        and v.dtype == currents.dtype
        and v.device == currents.device
        and v.shape == currents.shape[1:]
        and currents.numel() > 0
    )


def scan(
    currents: Tensor, v: Tensor, decay: float, v_th: float, width: float, surrogate: Surrogate = "rectangular"
) -> tuple[Tensor, Tensor]:
    """A LIF population over a sequence.

    Args:
        currents: (T, ...), accepted by `fits`; the result has the same memory layout.
        v: (...) potentials after the reset of the step before.
        decay: leak per step.
        v_th: firing threshold.
        width: width of the surrogate, in units of the potential.
        surrogate: kind of the surrogate gradient.

    Returns:
        spikes (T, ...) of 0 and 1, and the potentials after the last reset.
    """
    if torch.is_grad_enabled() and (currents.requires_grad or v.requires_grad):
        by_surrogate = _Scan if surrogate == "rectangular" else _GradedScan
        return by_surrogate.apply(currents, v, decay, v_th, width, surrogate)  # type: ignore[no-any-return, no-untyped-call]  # torch types apply as Any
    spikes, after, _ = _run(currents, v, decay, v_th, width, tape=False)
    return spikes, after


def scan_in_place(maps: Tensor, v: Tensor, decay: float, v_th: float) -> tuple[Tensor, Tensor]:
    """The same for maps of a convolution, without gradients; the spikes overwrite the currents.

    Args:
        maps: currents (T * B, C, H, W), channels last, float32 or float64; overwritten.
        v: potentials after the reset of the step before (B, C, H, W); not changed.
        decay: leak per step.
        v_th: firing threshold.

    Returns:
        spikes (T * B, C, H, W) and the potentials after the last reset, both channels last.
    """
    rows = maps.permute(0, 2, 3, 1)
    if not rows.is_contiguous():
        rows = rows.contiguous()
        maps = rows.permute(0, 3, 1, 2)
    before = np.ascontiguousarray(v.detach().numpy().transpose(0, 2, 3, 1))
    after = np.empty_like(before)
    kind = after.dtype.type
    _in_place(rows.numpy().reshape(-1, after.size), before.reshape(-1), after.reshape(-1), kind(decay), kind(v_th))
    return maps, torch.from_numpy(after).permute(0, 3, 1, 2)


class _Scan(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, currents: Tensor, v: Tensor, decay: float, v_th: float, width: float, _: Surrogate
    ) -> tuple[Tensor, Tensor]:  # torch's own type
        spikes, after, codes = _run(currents, v, decay, v_th, width, tape=True)
        ctx.save_for_backward(codes)
        ctx.decay, ctx.height, ctx.channels_last = decay, 1 / width, _is_channels_last(currents)
        return spikes, after

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor, None, None, None, None]:  # torch's own type
        return *_back(_backward, ctx, grads, ctx.decay, ctx.height), None, None, None, None


class _GradedScan(torch.autograd.Function):
    """The same for surrogates whose height depends on the distance of the potential from the threshold."""

    @staticmethod
    def forward(
        ctx: Any, currents: Tensor, v: Tensor, decay: float, v_th: float, width: float, surrogate: Surrogate
    ) -> tuple[Tensor, Tensor]:  # torch's own type
        channels_last = _is_channels_last(currents)
        rows, after = _rows(currents.detach(), channels_last), _flat(v.detach(), channels_last).clone()
        spikes, distances = torch.empty_like(rows), torch.empty_like(rows)
        kind = rows.numpy().dtype.type
        _forward_graded(rows.numpy(), after.numpy(), spikes.numpy(), distances.numpy(), kind(decay), kind(v_th))
        ctx.save_for_backward(distances)
        ctx.decay, ctx.width, ctx.channels_last, ctx.arctan = decay, width, channels_last, surrogate == "arctan"
        shape = currents.shape
        return _shaped(spikes, shape, channels_last), _shaped(after, shape[1:], channels_last)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor, None, None, None, None]:  # torch's own type
        return *_back(_backward_graded, ctx, grads, ctx.decay, ctx.width, arctan=ctx.arctan), None, None, None, None


def _back(
    kernel: Callable[..., None], ctx: Any, grads: tuple[Tensor, ...], *constants: float, **flags: bool
) -> tuple[Tensor, Tensor]:
    """Gradients with respect to the currents and the initial potentials; the kernel reads the tape of ctx."""
    (tape,) = ctx.saved_tensors
    by_spikes = _rows(grads[0], ctx.channels_last)
    by_v = _flat(grads[1], ctx.channels_last).clone()  # becomes the gradient of the initial potentials
    by_currents = torch.empty_like(by_spikes)
    kind = by_spikes.numpy().dtype.type
    kernel(by_spikes.numpy(), tape.numpy(), by_currents.numpy(), by_v.numpy(), *map(kind, constants), *flags.values())
    shape = grads[0].shape
    return _shaped(by_currents, shape, ctx.channels_last), _shaped(by_v, shape[1:], ctx.channels_last)


def _run(
    currents: Tensor, v: Tensor, decay: float, v_th: float, width: float, *, tape: bool
) -> tuple[Tensor, Tensor, Tensor]:
    channels_last = _is_channels_last(currents)
    rows, after = _rows(currents.detach(), channels_last), _flat(v.detach(), channels_last).clone()
    spikes = torch.empty_like(rows)
    codes = torch.empty(rows.shape if tape else (0, 0), dtype=torch.uint8)
    kind = rows.numpy().dtype.type
    constants = kind(decay), kind(v_th), kind(width / 2)
    _forward(rows.numpy(), after.numpy(), spikes.numpy(), codes.numpy(), *constants, tape)
    shape = currents.shape
    return _shaped(spikes, shape, channels_last), _shaped(after, shape[1:], channels_last), codes


def _is_channels_last(x: Tensor) -> bool:
    """Whether the channels, the third axis from the end, vary fastest in memory."""
    return x.dim() >= 4 and not x.is_contiguous() and x.movedim(-3, -1).is_contiguous()


def _rows(x: Tensor, channels_last: bool) -> Tensor:
    """(T, ...) as (T, N) in memory order; copied only where the memory has another order."""
    return (x.movedim(-3, -1) if channels_last else x).contiguous().view(x.shape[0], -1)


def _flat(x: Tensor, channels_last: bool) -> Tensor:
    return (x.movedim(-3, -1) if channels_last else x).contiguous().view(-1)


def _shaped(x: Tensor, shape: torch.Size, channels_last: bool) -> Tensor:
    """The inverse of `_rows` and `_flat`."""
    if not channels_last:
        return x.view(shape)
    *before, channels, rows, columns = shape
    return x.view(*before, rows, columns, channels).movedim(-1, -3)


@compiled
def _forward(
    currents: Array, v: Array, spikes: Array, codes: NDArray[np.uint8], decay: Any, v_th: Any, half: Any, tape: bool
) -> None:  # pragma: no cover (machine code)
    steps, n = currents.shape
    one, none = v.dtype.type(1), v.dtype.type(0)
    for start in range(0, n, _BLOCK):
        stop = min(start + _BLOCK, n)
        v_now = v[start:stop]
        for t in range(steps):
            current, s = currents[t, start:stop], spikes[t, start:stop]
            if tape:
                code = codes[t, start:stop]
                for i in range(stop - start):
                    u = decay * v_now[i] + current[i]
                    distance = u - v_th
                    fired = one if distance >= none else none
                    s[i] = fired
                    v_now[i] = u * (one - fired)
                    code[i] = (FIRED if distance >= none else 0) | (NEAR if abs(distance) < half else 0)
            else:
                for i in range(stop - start):
                    u = decay * v_now[i] + current[i]
                    fired = one if u - v_th >= none else none
                    s[i] = fired
                    v_now[i] = u * (one - fired)


@compiled
def _backward(
    by_spikes: Array, codes: NDArray[np.uint8], by_currents: Array, by_v: Array, decay: Any, height: Any
) -> None:  # pragma: no cover (machine code)
    steps, n = by_spikes.shape
    one, none = by_v.dtype.type(1), by_v.dtype.type(0)
    for start in range(0, n, _BLOCK):
        stop = min(start + _BLOCK, n)
        carried = by_v[start:stop]
        for t in range(steps - 1, -1, -1):
            pull, code, out = by_spikes[t, start:stop], codes[t, start:stop], by_currents[t, start:stop]
            for i in range(stop - start):
                slope = height if code[i] & NEAR else none
                kept = none if code[i] & FIRED else one
                u = pull[i] * slope + carried[i] * kept
                out[i] = u
                carried[i] = decay * u


@compiled
def _forward_graded(
    currents: Array, v: Array, spikes: Array, distances: Array, decay: Any, v_th: Any
) -> None:  # pragma: no cover (machine code)
    steps, n = currents.shape
    one, none = v.dtype.type(1), v.dtype.type(0)
    for start in range(0, n, _BLOCK):
        stop = min(start + _BLOCK, n)
        v_now = v[start:stop]
        for t in range(steps):
            current, s, distance = currents[t, start:stop], spikes[t, start:stop], distances[t, start:stop]
            for i in range(stop - start):
                u = decay * v_now[i] + current[i]
                distance[i] = u - v_th
                fired = one if u - v_th >= none else none
                s[i] = fired
                v_now[i] = u * (one - fired)


@compiled
def _backward_graded(
    by_spikes: Array, distances: Array, by_currents: Array, by_v: Array, decay: Any, width: Any, arctan: bool
) -> None:  # pragma: no cover (machine code)
    steps, n = by_spikes.shape
    one, none = by_v.dtype.type(1), by_v.dtype.type(0)
    per_width = by_v.dtype.type(math.pi) / width
    for start in range(0, n, _BLOCK):
        stop = min(start + _BLOCK, n)
        carried = by_v[start:stop]
        for t in range(steps - 1, -1, -1):
            pull, distance, out = by_spikes[t, start:stop], distances[t, start:stop], by_currents[t, start:stop]
            for i in range(stop - start):
                if arctan:
                    far = per_width * distance[i]
                    slope = one / (width * (one + far * far))
                else:
                    slope = max(one - abs(distance[i]) / width, none) / width
                kept = none if distance[i] >= none else one
                u = pull[i] * slope + carried[i] * kept
                out[i] = u
                carried[i] = decay * u


@compiled
def _in_place(
    currents: Array, before: Array, after: Array, decay: Any, v_th: Any
) -> None:  # pragma: no cover (machine code)
    steps, n = currents.shape
    one, none = after.dtype.type(1), after.dtype.type(0)
    for start in range(0, n, _BLOCK):
        stop = min(start + _BLOCK, n)
        v_before, v_now = before[start:stop], after[start:stop]
        for i in range(stop - start):
            v_now[i] = v_before[i]
        for t in range(steps):
            current = currents[t, start:stop]
            for i in range(stop - start):
                u = decay * v_now[i] + current[i]
                fired = one if u - v_th >= none else none
                current[i] = fired
                v_now[i] = u * (one - fired)
