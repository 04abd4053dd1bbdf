"""Convolutions and projection in 8-bit integers, for networks whose bundle asks for them: as in float32, bit for bit.

    precision = "int8": the weights of every convolution and of the projection are whole multiples q of a step per
    output channel, |q| <= 127, and the network's input is rounded to 1/32. Spikes are 0 or 1.

So a convolution or a projection is a sum of products of whole numbers, exact in any order and any arithmetic that can
hold it: int32, or float32 below 2**24. The norm's factor and offset follow in float32, one product and one sum for each
neuron, and then the LIF scan or the first cell. `neurons.plain()` computes the same with the public float32 operators;
tests compare bit for bit. Training sees the rounding (`rounded`) and passes gradients through it. Where the widths suit
its vectors sparse_int8.py sums over the neurons that fired alone; here are the dense forms.
"""

from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import conv2d, linear

from neurove_core.compiled import compiled
from neurove_core.engine import sparse_int8
from neurove_core.engine.convolution import Convolution, say_once
from neurove_core.engine.spike_lists import Fired, maps_of
from neurove_core.engine.vectors import LANES
from neurove_core.networks.quantisation import MAX_WEIGHT, Quantised, codes
from neurove_core.spiking.lif import LIFParams, LIFState, lif_scan_reference
from neurove_core.spiking.plain import is_plain

_EXACT: Final = 1 << 24  # whole numbers below this are exact in float32
_BLOCK: Final = 1024  # neurons whose potentials stay in the first cache over all steps
_GATHERED: Final = 256  # inputs whose weights are summed in 16 bits: 256 * 127 < 2**15

Array = NDArray[Any]


class Layer(NamedTuple):
    """One block of the extractor, whole numbers in and spikes out; or the projection, spikes in and currents out."""

    weights: Quantised
    factor: Tensor  # (C') float32: of the norm and the steps
    offset: Tensor  # (C') float32


class Extractor:
    """The feature extractor of one network in whole numbers.

    Args:
        layers: its blocks; the first sees codes, the others spikes.
        sizes: rows and columns of each block's input.
        lif: of its neurons.
    """

    def __init__(self, layers: list[Layer], sizes: list[tuple[int, int]], lif: LIFParams) -> None:
        self._layers, self._lif = layers, lif
        self._decay, self._v_th = np.float32(lif.decay), np.float32(lif.v_th)
        self._blocks = [(_over_a_block(layer.factor), _over_a_block(layer.offset)) for layer in layers]
        tops = [255] + [1] * (len(layers) - 1)
        self._plain = [plain_sums(layer.weights.q, top) for layer, top in zip(layers, tops, strict=True)]
        self._fast = [sums(layer.weights.q, top, *size) for layer, top, size in zip(layers, tops, sizes, strict=False)]
        over = [
            sparse_int8.Layer(layer.weights.q, layer.factor, layer.offset, dense, *size)
            for layer, dense, size in zip(layers, self._fast, sizes, strict=False)
        ]
        self._over_lists = sparse_int8.extractor(over, lif)

    def __call__(self, spikes: Tensor, membranes: tuple[LIFState, ...]) -> tuple[Tensor | Fired, tuple[LIFState, ...]]:
        """Input (T * B, 2n, H, W), as float32 or as uint8 codes, to spikes of the last map and potentials.

        Returns:
            who fired, or uint8 spikes (T * B, C', H', W') where layers are dense; and the potentials.
        """
        given = spikes if spikes.dtype == torch.uint8 else codes(spikes)
        if self._over_lists is not None and not is_plain():
            return self._over_lists(given, membranes)
        x = given.contiguous(memory_format=torch.channels_last)
        after = []
        for index, (layer, membrane) in enumerate(zip(self._layers, membranes, strict=True)):
            if is_plain():
                x, v = self._plain_fire(self._plain[index](x), layer, membrane.v)
            else:
                x, v = self._fire(self._fast[index](x), self._blocks[index], membrane.v)
            after.append(LIFState(v))
        return x, tuple(after)

    def _plain_fire(self, found: Tensor, layer: Layer, v: Tensor) -> tuple[Tensor, Tensor]:
        currents = found * layer.factor.view(-1, 1, 1) + layer.offset.view(-1, 1, 1)
        spikes, after = lif_scan_reference(currents.view(-1, *v.shape), LIFState(v), self._lif)
        return spikes.flatten(0, 1).to(torch.uint8), after.v

    def _fire(self, found: Tensor, block: tuple[Array, Array], v: Tensor) -> tuple[Tensor, Tensor]:
        rows = np.ascontiguousarray(found.numpy().transpose(0, 2, 3, 1))
        before = np.ascontiguousarray(v.detach().numpy().transpose(0, 2, 3, 1))
        spikes, after = np.empty(rows.shape, np.uint8), np.empty_like(before)
        steps = rows.reshape(-1, before.size), *block, before.reshape(-1), after.reshape(-1)
        _scan(*steps, self._decay, self._v_th, spikes.reshape(-1, before.size))
        return torch.from_numpy(spikes).permute(0, 3, 1, 2), torch.from_numpy(after).permute(0, 3, 1, 2)


class Projection:
    """The projection of one network in whole numbers: weights are read where a spike asks for them, and added up.

    Args:
        layer: its weights (F, I), in the order in which spikes lie in memory.
    """

    def __init__(self, layer: Layer) -> None:
        self.layer = layer
        self._largest = _largest_sum(layer.weights.q)
        self._rows = layer.weights.q.T.contiguous().numpy()  # (I, F): what one spike gives to all features

    def __call__(self, spikes: Tensor | Fired) -> Tensor:
        """Spikes (R, I), uint8 of 0 and 1, or who fired, to currents (R, F)."""
        (q, _), factor, offset = self.layer
        if isinstance(spikes, Fired):
            if factor.numel() % LANES == 0 and self._largest < 1 << 31:
                return torch.from_numpy(sparse_int8.project(spikes, self._rows, factor.numpy(), offset.numpy()))
            spikes = maps_of(spikes, np.uint8).permute(0, 2, 3, 1).flatten(1)
        if is_plain() or self._largest >= 1 << 31:
            kind = torch.float32 if self._largest < _EXACT else torch.float64
            return linear(spikes.to(kind), q.to(kind)).to(torch.float32) * factor + offset
        currents = torch.empty(spikes.shape[0], q.shape[0])
        _gather(spikes.numpy(), self._rows, factor.numpy(), offset.numpy(), currents.numpy())
        return currents


def _over_a_block(by_channel: Tensor) -> Array:
    """Numbers of the channels, again and again, for a block of neurons: a loop that the compiler turns into vectors."""
    return by_channel.repeat(max(1, _BLOCK // by_channel.numel())).numpy()


# --- sums of products of whole numbers --------------------------------------------------------------------------------


def sums(q: Tensor, top: int, rows: int, columns: int) -> Convolution:
    """A convolution of uint8 maps with int8 weights, its sums as float32, by this machine's 8-bit products.

    The operator is private to torch, and on processors without such products it may saturate: at load it is tried on
    the largest sums that there are. Where it is missing or wrong, `plain_sums` serves, slower; said once in the log.

    Args:
        q: (C', C, 3, 3) int8.
        top: largest number of a map.
        rows: of the map that it mostly sees.
        columns: of the same.
    """
    if not _exact_in_float32(q, top):
        return plain_sums(q, top)
    try:
        fast = _packed(q, rows, columns)
        agrees = _agrees(q, top, rows, columns)
    except (AttributeError, RuntimeError, NotImplementedError, TypeError) as error:
        say_once("8-bit convolutions", str(error).partition("\n")[0])
        return plain_sums(q, top)
    if not agrees:
        say_once("8-bit convolutions", "they compute something else")
        return plain_sums(q, top)
    return fast


def plain_sums(q: Tensor, top: int) -> Convolution:
    """The same by torch's public operator, in float32 where that holds every sum, else in float64."""
    kind = torch.float32 if _exact_in_float32(q, top) else torch.float64
    weight = q.to(kind).contiguous(memory_format=torch.channels_last)
    return lambda x: conv2d(x.to(kind), weight, stride=2, padding=1).to(torch.float32)


def _exact_in_float32(q: Tensor, top: int) -> bool:
    return _largest_sum(q) * top < _EXACT


def _largest_sum(q: Tensor) -> int:
    """Of any output, where every input is one."""
    return int(q.abs().flatten(1).sum(dim=1).max())  # torch adds up int8 in int64


def _packed(q: Tensor, rows: int, columns: int) -> Convolution:
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
    """Whether the private operator is exact: on the largest sums, of both signs, and on random ones; 1 and 3 maps."""
    generator = torch.Generator().manual_seed(0)
    random = torch.randint(-MAX_WEIGHT, MAX_WEIGHT + 1, q.shape, generator=generator, dtype=torch.int8)
    for weight in (torch.full_like(q, MAX_WEIGHT), torch.full_like(q, -MAX_WEIGHT), random, q):
        if not _exact_in_float32(weight, top):
            continue  # more than these weights can ever sum to
        fast, plain = _packed(weight, rows, columns), plain_sums(weight, top)
        for count in (1, 3):
            x = torch.randint(0, top + 1, (count, q.shape[1], rows, columns), generator=generator, dtype=torch.uint8)
            x[0] = top
            x = x.contiguous(memory_format=torch.channels_last)
            if not torch.equal(fast(x), plain(x)):
                return False
    return True


@compiled
def _scan(
    found: Array,
    factor: Array,
    offset: Array,
    before: Array,
    after: Array,
    decay: Any,
    v_th: Any,
    spikes: NDArray[np.uint8],
) -> None:  # pragma: no cover (machine code)
    """As scan._in_place, of currents found * factor + offset; channels vary fastest. Two steps are taken at a time.

    Args:
        found: (T, N).
        factor: of a block of neurons (M): those of the channels, again and again.
        offset: of the same.
        before: potentials (N).
        after: potentials (N), written.
        decay: per step.
        v_th: firing threshold.
        spikes: (T, N), written.
    """
    steps, n = found.shape
    one, none = after.dtype.type(1), after.dtype.type(0)
    even = steps - steps % 2
    for start in range(0, n, factor.size):
        stop = min(start + factor.size, n)
        v_before, v_now = before[start:stop], after[start:stop]
        for i in range(stop - start):
            v_now[i] = v_before[i]
        for t in range(0, even, 2):
            row, s = found[t, start:stop], spikes[t, start:stop]
            next_row, next_s = found[t + 1, start:stop], spikes[t + 1, start:stop]
            for i in range(stop - start):
                u = decay * v_now[i] + (row[i] * factor[i] + offset[i])
                fires = u - v_th >= none
                s[i] = np.uint8(fires)
                u = decay * (u * (none if fires else one)) + (next_row[i] * factor[i] + offset[i])
                fires = u - v_th >= none
                next_s[i] = np.uint8(fires)
                v_now[i] = u * (none if fires else one)
        for t in range(even, steps):
            row, s = found[t, start:stop], spikes[t, start:stop]
            for i in range(stop - start):
                u = decay * v_now[i] + (row[i] * factor[i] + offset[i])
                fires = u - v_th >= none
                s[i] = np.uint8(fires)
                v_now[i] = u * (none if fires else one)


@compiled
def _gather(
    spikes: NDArray[np.uint8], weights: NDArray[np.int8], factor: Array, offset: Array, currents: Array
) -> None:  # pragma: no cover (machine code)
    """Currents factor * sum + offset, sum = spikes times weights; rows of weights that no spike asks for are not read.

    Sums are of 32 bits and become float32 once, rounded where they are 2**24 or more, as those of float64 would.

    Args:
        spikes: (R, I) of 0 and 1.
        weights: (I, F).
        factor: of the features (F).
        offset: of the same.
        currents: (R, F), written.
    """
    rows, inputs = spikes.shape
    features = factor.size
    sums_of_rows, part = np.zeros((rows, features), np.int32), np.empty(features, np.int16)
    asked = np.empty(_GATHERED, np.int64)
    for start in range(0, inputs, _GATHERED):
        stop = min(start + _GATHERED, inputs)
        for r in range(rows):  # a block's weights stay in the second cache over all rows
            fired, found = spikes[r, start:stop], 0
            for i in range(stop - start):
                asked[found] = start + i
                found += fired[i]
            for j in range(features):
                part[j] = 0
            whole = found - found % 4
            for n in range(0, whole, 4):
                w0, w1, w2, w3 = weights[asked[n]], weights[asked[n + 1]], weights[asked[n + 2]], weights[asked[n + 3]]
                for j in range(features):
                    part[j] += np.int16(w0[j]) + np.int16(w1[j]) + np.int16(w2[j]) + np.int16(w3[j])
            for n in range(whole, found):
                w0 = weights[asked[n]]
                for j in range(features):
                    part[j] += np.int16(w0[j])
            total = sums_of_rows[r]
            for j in range(features):
                total[j] += np.int32(part[j])
    for r in range(rows):
        current, total = currents[r], sums_of_rows[r]
        for j in range(features):
            current[j] = np.float32(total[j]) * factor[j] + offset[j]
