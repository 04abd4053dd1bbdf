"""Convolutions and projection in 8-bit integers, for networks with precision int8; equal to float32 bit for bit.

    precision = "int8": the weights of every convolution and of the projection are integer multiples q of a step per
    output channel, |q| <= 127, and the network's input is rounded to 1/32. Spikes are 0 or 1.

So a convolution or a projection is a sum of integer products. It is exact in any order and in any arithmetic that can
hold it: int32, or float32 below 2**24. The norm's factor and offset follow in float32, one product and one sum for
each neuron, then the LIF scan or the first cell. Inside `plain()` the same is computed with the public float32
operators, and tests compare both bit for bit. Training applies the same rounding (`quantisation.rounded`) and passes
gradients through.

This module has the dense forms. Where the widths are multiples of LANES, sparse_int8.py sums over spike lists instead.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import conv2d, linear

from neurove_core.compiled import compiled
from neurove_core.engine.convolution import Convolution
from neurove_core.engine.fallback import reason_of, vectors_work, warn_once
from neurove_core.engine.spike_lists import SpikeList, to_maps
from neurove_core.engine.tiles import LANES
from neurove_core.networks.quantisation import Quantised, codes
from neurove_core.networks.tables import MAX_WEIGHT
from neurove_core.spiking.lif import LIFParams, LIFState, lif_scan_reference
from neurove_core.spiking.plain import is_plain

if TYPE_CHECKING:  # it needs the vector code, which may not work with this numba
    from neurove_core.engine.sparse_int8 import SparseInt8Extractor

_EXACT: Final = 1 << 24  # integers below this are exact in float32
_BLOCK: Final = 1024  # neurons whose potentials stay in the first-level cache over all steps
_GATHERED: Final = 256  # inputs whose weights are summed in 16 bits: 256 * 127 < 2**15

Array = NDArray[Any]


class Int8Layer(NamedTuple):
    """A layer of weights with its norm: a block of the extractor (integers to spikes), or the projection."""

    weights: Quantised
    factor: Tensor  # (C') float32: product of the norm's factor and the steps
    offset: Tensor  # (C') float32


class Int8Extractor:
    """The feature extractor of one network in 8-bit integers, over spike lists where possible, else dense.

    Args:
        layers: its blocks. The first one reads codes, the others read spikes.
        sizes: rows and columns of each block's input.
        lif: parameters of its neurons.
    """

    def __init__(self, layers: list[Int8Layer], sizes: list[tuple[int, int]], lif: LIFParams) -> None:
        self._layers, self._lif = layers, lif
        self._decay, self._v_th = np.float32(lif.decay), np.float32(lif.v_th)
        self._blocks = [(_over_a_block(layer.factor), _over_a_block(layer.offset)) for layer in layers]
        tops = [255] + [1] * (len(layers) - 1)
        self._plain = [plain_int8_convolution(layer.weights.q, top) for layer, top in zip(layers, tops, strict=True)]
        self._fast = [
            int8_convolution(layer.weights.q, top, *size) for layer, top, size in zip(layers, tops, sizes, strict=False)
        ]
        self._sparse = _over_lists(layers, self._fast, sizes, lif)

    def __call__(
        self, spikes: Tensor, membranes: tuple[LIFState, ...]
    ) -> tuple[Tensor | SpikeList, tuple[LIFState, ...]]:
        """Input (T * B, 2n, H, W), float32 or uint8 codes, to the spikes of the last map and the potentials.

        Returns:
            a spike list, or uint8 spikes (T * B, C', H', W') where layers are dense; and the potentials.
        """
        given = spikes if spikes.dtype == torch.uint8 else codes(spikes)
        if self._sparse is not None and not is_plain():
            return self._sparse(given, membranes)
        x = given.contiguous(memory_format=torch.channels_last)
        after = []
        for index, (layer, membrane) in enumerate(zip(self._layers, membranes, strict=True)):
            if is_plain():
                x, v = self._plain_fire(self._plain[index](x), layer, membrane.v)
            else:
                x, v = self._fire(self._fast[index](x), self._blocks[index], membrane.v)
            after.append(LIFState(v))
        return x, tuple(after)

    def _plain_fire(self, sums: Tensor, layer: Int8Layer, v: Tensor) -> tuple[Tensor, Tensor]:
        currents = sums * layer.factor.view(-1, 1, 1) + layer.offset.view(-1, 1, 1)
        spikes, after = lif_scan_reference(currents.view(-1, *v.shape), LIFState(v), self._lif)
        return spikes.flatten(0, 1).to(torch.uint8), after.v

    def _fire(self, sums: Tensor, block: tuple[Array, Array], v: Tensor) -> tuple[Tensor, Tensor]:
        rows = np.ascontiguousarray(sums.numpy().transpose(0, 2, 3, 1))
        before = np.ascontiguousarray(v.detach().numpy().transpose(0, 2, 3, 1))
        spikes, after = np.empty(rows.shape, np.uint8), np.empty_like(before)
        steps = rows.reshape(-1, before.size), *block, before.reshape(-1), after.reshape(-1)
        _scan(*steps, self._decay, self._v_th, spikes.reshape(-1, before.size))
        return torch.from_numpy(spikes).permute(0, 3, 1, 2), torch.from_numpy(after).permute(0, 3, 1, 2)


def _over_lists(
    layers: list[Int8Layer], dense: list[Convolution], sizes: list[tuple[int, int]], lif: LIFParams
) -> "SparseInt8Extractor | None":
    """The extractor over spike lists, or None where it does not work with these widths or on this machine."""
    if not vectors_work():
        return None
    from neurove_core.engine.sparse_int8 import SparseInt8Layer, sparse_int8_extractor

    over = [
        SparseInt8Layer(layer.weights.q, layer.factor, layer.offset, convolve, *size)
        for layer, convolve, size in zip(layers, dense, sizes, strict=False)
    ]
    return sparse_int8_extractor(over, lif)


class Int8Projection:
    """The projection of one network in 8-bit integers: only the weight rows of spikes are read and summed.

    Args:
        layer: its weights (F, I), inputs in the memory order of the spikes.
    """

    def __init__(self, layer: Int8Layer) -> None:
        self.layer = layer
        self._largest = _largest_sum(layer.weights.q)
        self._rows = layer.weights.q.T.contiguous().numpy()  # (I, F): weights of one input to all features
        self._project_list = self._list_projection()

    def __call__(self, spikes: Tensor | SpikeList) -> Tensor:
        """Spikes (R, I), uint8 of 0 and 1, or a spike list, to currents (R, F)."""
        (q, _), factor, offset = self.layer
        if isinstance(spikes, SpikeList):
            if self._project_list is not None:
                return torch.from_numpy(self._project_list(spikes, self._rows, factor.numpy(), offset.numpy()))
            spikes = to_maps(spikes, np.uint8).permute(0, 2, 3, 1).flatten(1)
        if is_plain() or self._largest >= 1 << 31:
            kind = torch.float32 if self._largest < _EXACT else torch.float64
            return linear(spikes.to(kind), q.to(kind)).to(torch.float32) * factor + offset
        currents = torch.empty(spikes.shape[0], q.shape[0])
        _gather(spikes.numpy(), self._rows, factor.numpy(), offset.numpy(), currents.numpy())
        return currents

    def _list_projection(self) -> Callable[[SpikeList, NDArray[np.int8], Array, Array], Array] | None:
        """The projection over a spike list where it is exact, else None."""
        factor, offset = self.layer.factor.numpy(), self.layer.offset.numpy()
        if factor.size % LANES or self._largest >= 1 << 31 or not vectors_work():
            return None
        try:
            from neurove_core.engine.sparse_int8 import project, projects

            if projects(self._rows, factor, offset):
                return project
            reason = "its results differ"
        except Exception as error:  # noqa: BLE001  # numba raises anything while it compiles
            reason = reason_of(error)
        warn_once("8-bit projection over spike lists", reason)
        return None


def _over_a_block(by_channel: Tensor) -> Array:
    """Values of the channels, repeated for a block of neurons, so that the compiler can vectorise the loop."""
    return by_channel.repeat(max(1, _BLOCK // by_channel.numel())).numpy()


# --- dense integer sums -----------------------------------------------------------------------------------------------


def int8_convolution(q: Tensor, top: int, rows: int, columns: int) -> Convolution:
    """A convolution of uint8 maps with int8 weights, its sums as float32, by this machine's 8-bit products.

    The operator is private to torch, and it may saturate on processors without such products. When a model is loaded,
    it is checked on the largest possible sums. Where it is missing or wrong, `plain_int8_convolution` is used and one
    warning is logged.

    Args:
        q: (C', C, 3, 3) int8.
        top: largest value in a map.
        rows: rows of the usual input map.
        columns: columns of the usual input map.
    """
    if not _exact_in_float32(q, top):
        return plain_int8_convolution(q, top)
    try:
        fast = _prepacked(q, rows, columns)
        agrees = _agrees(q, top, rows, columns)
    except (AttributeError, RuntimeError, NotImplementedError, TypeError) as error:
        warn_once("8-bit convolution", reason_of(error))
        return plain_int8_convolution(q, top)
    if not agrees:
        warn_once("8-bit convolution", "its results differ")
        return plain_int8_convolution(q, top)
    return fast


def plain_int8_convolution(q: Tensor, top: int) -> Convolution:
    """The reference implementation by torch's public operator, in float32 where every sum is exact, else in float64."""
    kind = torch.float32 if _exact_in_float32(q, top) else torch.float64
    weight = q.to(kind).contiguous(memory_format=torch.channels_last)
    return lambda x: conv2d(x.to(kind), weight, stride=2, padding=1).to(torch.float32)


def _exact_in_float32(q: Tensor, top: int) -> bool:
    return _largest_sum(q) * top < _EXACT


def _largest_sum(q: Tensor) -> int:
    """The largest absolute sum of any output, where every input is one."""
    return int(q.abs().flatten(1).sum(dim=1).max())  # torch sums int8 in int64


def _prepacked(q: Tensor, rows: int, columns: int) -> Convolution:
    run: Callable[..., Tensor] = torch.ops.onednn.qconv2d_pointwise.default
    one, zero = torch.ones(q.shape[0]), torch.zeros(q.shape[0], dtype=torch.int32)
    where: tuple[list[int], ...] = ([2, 2], [1, 1], [1, 1])  # stride, padding, dilation
    with torch.inference_mode():
        own = torch.ops.onednn.qconv_prepack(q, one, 1.0, 0, *where, 1, [1, q.shape[1], rows, columns])

    def convolve(x: Tensor) -> Tensor:
        return run(x, 1.0, 0, own, one, zero, None, *where, 1, 1.0, 0, torch.float32, "none", [], "")

    return convolve


@torch.inference_mode()
def _agrees(q: Tensor, top: int, rows: int, columns: int) -> bool:
    """Whether the private operator is exact: largest sums of both signs and random ones, on one map and on three."""
    generator = torch.Generator().manual_seed(0)
    random = torch.randint(-MAX_WEIGHT, MAX_WEIGHT + 1, q.shape, generator=generator, dtype=torch.int8)
    for weight in (torch.full_like(q, MAX_WEIGHT), torch.full_like(q, -MAX_WEIGHT), random, q):
        if not _exact_in_float32(weight, top):
            continue  # larger than any sum of these weights
        fast, plain = _prepacked(weight, rows, columns), plain_int8_convolution(weight, top)
        for count in (1, 3):
            x = torch.randint(0, top + 1, (count, q.shape[1], rows, columns), generator=generator, dtype=torch.uint8)
            x[0] = top
            x = x.contiguous(memory_format=torch.channels_last)
            if not torch.equal(fast(x), plain(x)):
                return False
    return True


@compiled
def _scan(
    sums: Array,
    factor: Array,
    offset: Array,
    before: Array,
    after: Array,
    decay: Any,
    v_th: Any,
    spikes: NDArray[np.uint8],
) -> None:  # pragma: no cover (machine code)
    """The LIF scan of currents sums * factor + offset, channels last; two steps at a time.

    Args:
        sums: (T, N) integer sums as float32.
        factor: (M) factors of a block of neurons, the channels repeated.
        offset: (M) offsets of the same.
        before: (N) membrane potentials before the first step.
        after: (N) potentials after the last reset, written.
        decay: leak per step.
        v_th: firing threshold.
        spikes: (T, N), written.
    """
    steps, n = sums.shape
    one, none = after.dtype.type(1), after.dtype.type(0)
    even = steps - steps % 2
    for start in range(0, n, factor.size):
        stop = min(start + factor.size, n)
        v_before, v_now = before[start:stop], after[start:stop]
        for i in range(stop - start):
            v_now[i] = v_before[i]
        for t in range(0, even, 2):
            row, s = sums[t, start:stop], spikes[t, start:stop]
            next_row, next_s = sums[t + 1, start:stop], spikes[t + 1, start:stop]
            for i in range(stop - start):
                u = decay * v_now[i] + (row[i] * factor[i] + offset[i])
                fires = u - v_th >= none
                s[i] = np.uint8(fires)
                u = decay * (u * (none if fires else one)) + (next_row[i] * factor[i] + offset[i])
                fires = u - v_th >= none
                next_s[i] = np.uint8(fires)
                v_now[i] = u * (none if fires else one)
        for t in range(even, steps):
            row, s = sums[t, start:stop], spikes[t, start:stop]
            for i in range(stop - start):
                u = decay * v_now[i] + (row[i] * factor[i] + offset[i])
                fires = u - v_th >= none
                s[i] = np.uint8(fires)
                v_now[i] = u * (none if fires else one)


@compiled
def _gather(
    spikes: NDArray[np.uint8], weights: NDArray[np.int8], factor: Array, offset: Array, currents: Array
) -> None:  # pragma: no cover (machine code)
    """Currents factor * sum + offset, where sum adds the weight rows of the spikes; no other rows are read.

    Sums have 32 bits and are converted to float32 once, rounded from 2**24 on, as float64 sums would be.

    Args:
        spikes: (R, I) of 0 and 1.
        weights: (I, F).
        factor: (F).
        offset: (F).
        currents: (R, F), written.
    """
    rows, inputs = spikes.shape
    features = factor.size
    sums_of_rows, part = np.zeros((rows, features), np.int32), np.empty(features, np.int16)
    wanted = np.empty(_GATHERED, np.int64)
    for start in range(0, inputs, _GATHERED):
        stop = min(start + _GATHERED, inputs)
        for r in range(rows):  # a block's weights stay in the second-level cache over all rows
            fired, found = spikes[r, start:stop], 0
            for i in range(stop - start):
                wanted[found] = start + i
                found += fired[i]
            for j in range(features):
                part[j] = 0
            whole = found - found % 4
            for n in range(0, whole, 4):
                w0, w1, w2, w3 = (
                    weights[wanted[n]],
                    weights[wanted[n + 1]],
                    weights[wanted[n + 2]],
                    weights[wanted[n + 3]],
                )
                for j in range(features):
                    part[j] += np.int16(w0[j]) + np.int16(w1[j]) + np.int16(w2[j]) + np.int16(w3[j])
            for n in range(whole, found):
                w0 = weights[wanted[n]]
                for j in range(features):
                    part[j] += np.int16(w0[j])
            total = sums_of_rows[r]
            for j in range(features):
                total[j] += np.int32(part[j])
    for r in range(rows):
        current, total = currents[r], sums_of_rows[r]
        for j in range(features):
            current[j] = np.float32(total[j]) * factor[j] + offset[j]
