"""ALIF neurons: LIF with astrocyte diffusion across layers and across time.

    J(i, j) = D (V_i - V_j)                                            Eq. (2); with V_j = 0: J = D V_i
    v = decay v' + f(spikes_before + d_space v_before) + d_time v'     membrane potential before the reset
    s = [v >= v_th];  v <- v (1 - s)

Source: NeuroVE, Eq. (2), Eq. (3): tau dV/dt = -(V - V_rest) + R (I + J), and its iterative form, Eq. (6a) to (6c):
V(t+1) = (1 - S) V + f(X + D V_i), S = H(V). J across time, J(t-1, t) = D V(t-1), is that of Eq. (9).
Differs: the leak `decay` is kept, which Eq. (6a) drops; so D is the only difference from LIF (decision 4).
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn

from neurove_core.spiking.layers import require, require_sequence, require_shape_of_layer
from neurove_core.spiking.lif import LIFParams, LIFState, NeuronSteps, fire, lif_params
from neurove_core.spiking.surrogate import Surrogate


class ALIFParams(NamedTuple):
    """Constants of an ALIF population; each diffusion is one coefficient, or one for each neuron."""

    lif: LIFParams
    d_space: Tensor | float  # D of J = D V_i: from the neurons of the previous layer, inside f (Eq. 6a)
    d_time: Tensor | float = 0.0  # D of J(t-1, t) = D V(t-1): from the same neuron one step ago (Eq. 9)


def alif_step(
    spikes_before: Tensor,
    v_before: Tensor,
    state: LIFState,
    params: ALIFParams,
    f: Callable[[Tensor], Tensor],
) -> tuple[Tensor, LIFState]:
    """One time step of an ALIF population with input from the previous layer.

    Source: NeuroVE, Eq. (6): V <- (1 - S) V + f(X + D V_i), S = [V >= v_th].
    Differs: the leak is kept, see the module (decision 4).

    Args:
        spikes_before: X, spikes of the previous layer (B, M).
        v_before: V_i, its membrane potentials at this step (B, M).
        state: state of this population (B, N).
        params: threshold, leak and diffusion.
        f: the operator from M to N, a linear map or a convolution.

    Returns:
        spikes (B, N) and the next state.
    """
    current = f(diffuse(spikes_before, v_before, params.d_space))
    return fire(alif_potential(current, state, params), params.lif)


def alif_potential(current: Tensor, state: LIFState, params: ALIFParams) -> Tensor:
    """The membrane potential v of an ALIF population before the reset; current is f(X + D V_i) of Eq. (6a)."""
    return params.lif.decay * state.v + current + params.d_time * state.v


def diffuse(spikes: Tensor, v: Tensor, d: Tensor | float) -> Tensor:
    """X + D V, the input of the next layer: spikes plus the potential that diffuses (Eq. 2, 6a)."""
    return spikes + d * v


class ALIF(nn.Module):
    """A layer of N ALIF neurons, f a linear map, both diffusions learnable, state in and out.

    Source: NeuroVE, Eq. (6), as alif_step; across time J(t-1, t) of Eq. (9).

    Args:
        inputs: I, width of the previous layer.
        hidden: N, number of neurons.
        decay: 1 - dt/tau per step, 0 to below 1; the literal leakless Eq. (6a) is the limit 1.
        v_th: firing threshold.
        d_space: initial D of J = D V_i, one per neuron of the previous layer.
        d_time: initial D of J(t-1, t) = D V(t-1) of the same neuron, one per neuron.
        surrogate: kind of the spike's surrogate gradient.
        surrogate_width: width of the surrogate, in units of the potential.

    Raises:
        InvalidField: a value is out of its bounds.
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
        require(0 <= d_time < 1, "ALIF", "d_time", d_time, "must be at least 0 and below 1, because it acts as a leak")
        self.hidden = hidden
        self.lif = lif_params("ALIF", decay, v_th, surrogate, surrogate_width)
        self.f = nn.Linear(inputs, hidden)
        self.d_space = nn.Parameter(torch.full((inputs,), float(d_space)))
        self.d_time = nn.Parameter(torch.full((hidden,), float(d_time)))

    def params(self) -> ALIFParams:
        """The constants and diffusions for alif_step; f is the layer's `f`."""
        return ALIFParams(self.lif, self.d_space, self.d_time)

    def initial_state(self, batch: int) -> LIFState:
        """The zero state."""
        return LIFState(self.f.weight.new_zeros(batch, self.hidden))

    def forward(self, x: Tensor, state: LIFState, v_before: Tensor | None = None) -> tuple[NeuronSteps, LIFState]:
        """Scan a sequence to spikes and potentials of all steps, and the last state.

        Args:
            x: X, spikes of the previous layer, or an external input (T, B, I).
            state: from initial_state or the previous call.
            v_before: V_i, potentials of the previous layer (T, B, I), NeuronSteps.v; None where there is no such layer.

        Raises:
            InvalidField: x or v_before is not a sequence of this width, or the state has another batch size.
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
