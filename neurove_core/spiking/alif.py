"""ALIF: LIF neurons with astrocyte diffusion across layers and across time; Eq. (2), (3), (6)."""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn

from neurove_core.spiking.layers import require, require_sequence, require_shape_of_layer
from neurove_core.spiking.lif import LIFParams, LIFState, NeuronSteps, fire, lif_params
from neurove_core.spiking.surrogate import Surrogate


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
