"""LIF, ALIF and LTC: parameters, state, one step, and a module that scans a sequence. State goes in and comes out.

Conventions of all: V_rest = 0; a spike is V >= v_th; the reset is hard (to 0) and is applied when the state is
stored, which is the same as the factor (1 - S) of the paper's next step. The gradient through the reset is cut.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import linear

from neurove_core.spiking.fused import scan
from neurove_core.spiking.layers import (
    drawn_weights,
    require,
    require_sequence,
    require_shape_of_layer,
    require_threshold,
    require_width,
    scan_of,
)
from neurove_core.spiking.surrogate import Surrogate, spike


class LIFParams(NamedTuple):
    """Leaky integrate-and-fire: decay = 1 - dt/tau per step, threshold v_th, and the surrogate of its spike."""

    decay: float = 0.5
    v_th: float = 1.0
    surrogate: Surrogate = "rectangular"
    surrogate_width: float = 1.0


class LIFState(NamedTuple):
    """What a population of neurons carries to the next step."""

    v: Tensor  # membrane potential after the reset, dimensionless, any shape


class NeuronSteps(NamedTuple):
    """What a population did in each step of a sequence."""

    s: Tensor  # spikes of 0 and 1 (T, B, N)
    v: Tensor  # membrane potential before the reset (T, B, N): what may diffuse into the layer above


def fire(v: Tensor, params: LIFParams) -> tuple[Tensor, LIFState]:
    """Spikes of the membrane potential v, and the state with the fired neurons reset to 0."""
    spikes = spike(v - params.v_th, params.surrogate, params.surrogate_width)
    return spikes, LIFState(v * (1 - spikes.detach()))


def lif_step(current: Tensor, state: LIFState, params: LIFParams) -> tuple[Tensor, LIFState]:
    """Leak, integrate, fire, reset: one time step of a LIF population.

    Source: NeuroVE, Eq. (1), Euler step as Eq. (4) with J = 0; Wu 2018.
    Differs: beta R is part of the current, as in Eq. (6a).

    Args:
        current: input of this step, any shape.
        state: from the step before; zeros at the start.
        params: of the whole population.

    Returns:
        spikes of 0 and 1 in the shape of `current`, and the next state.
    """
    return fire(params.decay * state.v + current, params)


class ALIFParams(NamedTuple):
    """A LIF population with the two astrocyte diffusions of the paper, each a coefficient or one per neuron."""

    lif: LIFParams
    d_space: Tensor | float  # D of J = D V_i: from the neurons of the layer before, inside f (Eq. 6a)
    d_time: Tensor | float = 0.0  # D of J(t-1, t) = D V(t-1): from the same neuron one step ago (Eq. 9)


def alif_step(
    spikes_before: Tensor,
    v_before: Tensor,
    state: LIFState,
    params: ALIFParams,
    f: Callable[[Tensor], Tensor],
) -> tuple[Tensor, LIFState]:
    """One time step of an ALIF population fed by the layer before it.

    Source: NeuroVE, Eq. (6): V <- (1 - S) V + f(X + D V_i), S = [V >= v_th].
    Differs: keeps the leak that Eq. (6) simplifies away, so that D is its only difference to LIF (decision 4).

    Args:
        spikes_before: X, spikes of the layer before (B, M).
        v_before: V_i, its membrane potentials at this step (B, M).
        state: of this population (B, N).
        params: thresholds, leak, diffusion.
        f: the operator from M to N, linear or convolution.

    Returns:
        spikes (B, N) and the next state.
    """
    current = f(diffuse(spikes_before, v_before, params.d_space))
    return fire(alif_potential(current, state, params), params.lif)


def alif_potential(current: Tensor, state: LIFState, params: ALIFParams) -> Tensor:
    """The membrane potential V of an ALIF population before it fires; current is f(X + D V_i) (Eq. 6a)."""
    return params.lif.decay * state.v + current + params.d_time * state.v


def diffuse(spikes: Tensor, v: Tensor, d: Tensor | float) -> Tensor:
    """X + D V: what the next layer receives, spikes and the potential that diffuses beside them (Eq. 2, 6a)."""
    return spikes + d * v


def lif_scan(currents: Tensor, state: LIFState, params: LIFParams) -> tuple[Tensor, LIFState]:
    """A LIF population over a sequence: currents (T, ...) to spikes (T, ...) and the last state.

    On a CPU this is one compiled pass over all steps (scan.py); else, or inside `plain()`, it is `lif_scan_reference`.
    Spikes and state are the same bit for bit.
    """
    if currents.dtype in (torch.bfloat16, torch.float16) and state.v.dtype == torch.float32:
        currents = currents.float()  # as a sum with the potentials would: autocast keeps maps in half precision
    if not is_plain() and scan.fits(currents, state.v):
        spikes, v = scan.scan(currents, state.v, params.decay, params.v_th, params.surrogate_width, params.surrogate)
        return spikes, LIFState(v)
    return lif_scan_reference(currents, state, params)


def lif_scan_reference(currents: Tensor, state: LIFState, params: LIFParams) -> tuple[Tensor, LIFState]:
    """What lif_scan computes, one plain step after the other."""
    spikes = []
    for current in currents:
        out, state = lif_step(current, state, params)
        spikes.append(out)
    return torch.stack(spikes), state


_PLAIN: ContextVar[bool] = ContextVar("plain", default=False)


@contextmanager
def plain() -> Iterator[None]:
    """Inside this, nothing is fused: each step is plain PyTorch, the reference that the fast path is held against."""
    token = _PLAIN.set(True)
    try:
        yield
    finally:
        _PLAIN.reset(token)


def is_plain() -> bool:
    """Whether the caller runs inside `plain()`."""
    return _PLAIN.get()


class LTCParams(NamedTuple):
    """Weights of a population of N liquid time-constant spiking neurons (Yin 2023)."""

    w_x: Tensor  # (N, I)
    w_s: Tensor  # (N, N): the population's own spikes of the step before
    b: Tensor  # (N)
    w_a: Tensor  # (N, 2N): of the time constant, first N columns for d, then N for m
    b_a: Tensor  # (N)
    v_th: float = 0.5
    surrogate: Surrogate = "rectangular"
    surrogate_width: float = 1.0


class LTCState(NamedTuple):
    """What a population of liquid time-constant neurons carries to the next step."""

    m: Tensor  # membrane potential after the reset (B, N)
    s: Tensor  # spikes (B, N)


def ltc_step(x: Tensor, state: LTCState, params: LTCParams) -> LTCState:
    """One time step of an LTC population; the state that comes out holds its spikes s.

    Source: Yin 2023, the baseline LTC of NeuroVE, section IV-B:
        d = W [x, s'] + b;  a = sigmoid(W_a [d, m'] + b_a);  u = m' + (d - m') a
        s = [u >= v_th];  m = u (1 - s)
    Differs: fires at u >= v_th, as all neurons here (Yin: u > v_th); the gradient through the reset is cut.

    Args:
        x: input (B, I).
        state: of the step before; zeros at the start.
        params: of the whole population.

    Raises:
        InvalidField: x is not I wide.
    """
    require_width("LTC", x, params.w_x.shape[1])
    d = linear(x, params.w_x, params.b) + linear(state.s, params.w_s)
    a = torch.sigmoid(linear(torch.cat((d, state.m), dim=-1), params.w_a, params.b_a))
    u = state.m + (d - state.m) * a
    s = spike(u - params.v_th, params.surrogate, params.surrogate_width)
    return LTCState(u * (1 - s.detach()), s)


class LIF(nn.Module):
    """A population of N LIF neurons without weights, state in and out: its input is the current of each neuron.

    Source: NeuroVE, Eq. (1) and (4), as lif_step.

    Args:
        hidden: N, number of neurons.
        decay: 1 - dt/tau per step, 0 (no memory) to below 1.
        v_th: firing threshold.
        surrogate: of the spike's gradient.
        surrogate_width: of the same, in units of the potential.

    Raises:
        InvalidField: a value is out of its bound.

    >>> neurons = LIF(1, decay=0.5)
    >>> steps, last = neurons(torch.full((4, 1, 1), 0.6), neurons.initial_state(batch=1))
    >>> steps.s.flatten()
    tensor([0., 0., 1., 0.])
    """

    _origin: Tensor

    def __init__(
        self,
        hidden: int,
        *,
        decay: float = 0.5,
        v_th: float = 1.0,
        surrogate: Surrogate = "rectangular",
        surrogate_width: float = 1.0,
    ) -> None:
        super().__init__()
        require_shape_of_layer("LIF", hidden=hidden)
        self.hidden = hidden
        self._params = lif_params("LIF", decay, v_th, surrogate, surrogate_width)
        self.register_buffer("_origin", torch.zeros(()), persistent=False)  # knows the module's dtype and device

    def params(self) -> LIFParams:
        """The population's constants, for lif_step."""
        return self._params

    def initial_state(self, batch: int) -> LIFState:
        """Everything at rest."""
        return LIFState(self._origin.new_zeros(batch, self.hidden))

    def forward(self, x: Tensor, state: LIFState) -> tuple[NeuronSteps, LIFState]:
        """Scan a sequence: currents (T, B, N) to spikes and potentials of all steps, and the last state.

        Raises:
            InvalidField: x is no sequence of this width, or the state is not of its batch.
        """
        require_sequence("LIF", x, self.hidden, state, self.hidden)
        spikes, potentials = [], []
        for current in x:
            v = self._params.decay * state.v + current
            s, state = fire(v, self._params)
            spikes.append(s)
            potentials.append(v)
        return NeuronSteps(torch.stack(spikes), torch.stack(potentials)), state


class ALIF(nn.Module):
    """A layer of N ALIF neurons, f a linear map, both diffusions learnable, state in and out.

    Source: NeuroVE, Eq. (6), as alif_step; across time J(t-1, t) of Eq. (9).

    Args:
        inputs: I, width of the layer before.
        hidden: N, number of neurons.
        decay: 1 - dt/tau per step, 0 to below 1; the literal leakless Eq. (6a) is the limit 1.
        v_th: firing threshold.
        d_space: initial D of J = D V_i, one per neuron of the layer before.
        d_time: initial D of J(t-1, t) = D V(t-1) of the same neuron, one per neuron.
        surrogate: of the spike's gradient.
        surrogate_width: of the same, in units of the potential.

    Raises:
        InvalidField: a value is out of its bound.
    """

    def __init__(
        self,
        inputs: int,
        hidden: int,
        *,
        decay: float = 0.5,
        v_th: float = 1.0,
        d_space: float = 0.5,
        d_time: float = 0.2,
        surrogate: Surrogate = "rectangular",
        surrogate_width: float = 1.0,
    ) -> None:
        super().__init__()
        require_shape_of_layer("ALIF", inputs=inputs, hidden=hidden)
        require(0 <= d_space < math.inf, "ALIF", "d_space", d_space, "must be at least 0 and finite")
        require(0 <= d_time < 1, "ALIF", "d_time", d_time, "must be at least 0 and below 1, for it acts as a leak")
        self.hidden = hidden
        self.lif = lif_params("ALIF", decay, v_th, surrogate, surrogate_width)
        self.f = nn.Linear(inputs, hidden)
        self.d_space = nn.Parameter(torch.full((inputs,), float(d_space)))
        self.d_time = nn.Parameter(torch.full((hidden,), float(d_time)))

    def params(self) -> ALIFParams:
        """The layer's constants and diffusions, for alif_step; f is the layer's `f`."""
        return ALIFParams(self.lif, self.d_space, self.d_time)

    def initial_state(self, batch: int) -> LIFState:
        """Everything at rest."""
        return LIFState(self.f.weight.new_zeros(batch, self.hidden))

    def forward(self, x: Tensor, state: LIFState, v_before: Tensor | None = None) -> tuple[NeuronSteps, LIFState]:
        """Scan a sequence to spikes and potentials of all steps, and the last state.

        Args:
            x: X, spikes of the layer before, or plain input (T, B, I).
            state: from initial_state or the call before.
            v_before: V_i, potentials of the layer before (T, B, I), NeuronSteps.v; None where there is no such layer.

        Raises:
            InvalidField: x or v_before is no sequence of this width, or the state is not of its batch.
        """
        require_sequence("ALIF", x, self.f.in_features, state, self.hidden)
        if v_before is not None:
            bound = f"must have the shape of x, {tuple(x.shape)}"
            require(v_before.shape == x.shape, "ALIF", "v_before.shape", tuple(v_before.shape), bound)
            x = diffuse(x, v_before, self.d_space)
        params, spikes, potentials = self.params(), [], []
        for current in self.f(x):
            v = alif_potential(current, state, params)
            s, state = fire(v, self.lif)
            spikes.append(s)
            potentials.append(v)
        return NeuronSteps(torch.stack(spikes), torch.stack(potentials)), state


class LTC(nn.Module):
    """A layer of N liquid time-constant spiking neurons, recurrent through its spikes, state in and out.

    Source: Yin 2023, as ltc_step.

    Args:
        inputs: I, width of the input.
        hidden: N, number of neurons.
        v_th: firing threshold; 0.5 is Yin's.
        surrogate: of the spike's gradient.
        surrogate_width: of the same, in units of the potential.

    Raises:
        InvalidField: a value is out of its bound.
    """

    def __init__(
        self,
        inputs: int,
        hidden: int,
        *,
        v_th: float = 0.5,
        surrogate: Surrogate = "rectangular",
        surrogate_width: float = 1.0,
    ) -> None:
        super().__init__()
        require_shape_of_layer("LTC", inputs=inputs, hidden=hidden)
        require_threshold("LTC", v_th, surrogate, surrogate_width)
        self.hidden = hidden
        self.w_x = drawn_weights(hidden, hidden, inputs)
        self.w_s = drawn_weights(hidden, hidden, hidden)
        self.b = drawn_weights(hidden, hidden)
        self.w_a = drawn_weights(hidden, hidden, 2 * hidden)
        self.b_a = drawn_weights(hidden, hidden)
        self._constants = (v_th, surrogate, surrogate_width)

    def params(self) -> LTCParams:
        """The layer's weights, for ltc_step."""
        return LTCParams(self.w_x, self.w_s, self.b, self.w_a, self.b_a, *self._constants)

    def initial_state(self, batch: int) -> LTCState:
        """Everything at rest."""
        zeros = self.w_x.new_zeros(batch, self.hidden)
        return LTCState(zeros, zeros)

    def forward(self, x: Tensor, state: LTCState) -> tuple[LTCState, LTCState]:
        """Scan a sequence: x (T, B, I) to the states of all steps, each field (T, B, N), and the last one.

        Raises:
            InvalidField: x is no sequence of this width, or the state is not of its batch.
        """
        params = self.params()
        require_sequence("LTC", x, params.w_x.shape[1], state, self.hidden)
        return scan_of(ltc_step, x, state, params)


def lif_params(what: str, decay: float, v_th: float, surrogate: Surrogate, surrogate_width: float) -> LIFParams:
    """Checked parameters of the LIF part of a neuron called `what`."""
    require(0 <= decay < 1, what, "decay", decay, "must be at least 0 and below 1")
    require_threshold(what, v_th, surrogate, surrogate_width)
    return LIFParams(decay, v_th, surrogate, surrogate_width)
