"""LTC: liquid time-constant spiking neurons, a baseline of the paper.

    d = W_x x + W_s s' + b                  input current
    a = sigmoid(W_a [d, m'] + b_a)          inverse time constant, 0 to 1
    u = m' + (d - m') a                     membrane potential before the reset
    s = [u >= v_th];  m = u (1 - s)         spike, and the potential after the reset

Source: Yin 2023, the baseline LTC of NeuroVE, section IV-B.
Differs: fires at u >= v_th, as all neurons here (Yin: u > v_th). No gradient flows through the reset.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import linear

from neurove_core.spiking.layers import (
    drawn_weights,
    require_sequence,
    require_shape_of_layer,
    require_threshold,
    require_width,
    scan_of,
)
from neurove_core.spiking.surrogate import Surrogate, spike


class LTCParams(NamedTuple):
    """Weights of a population of N liquid time-constant spiking neurons."""

    w_x: Tensor  # (N, I)
    w_s: Tensor  # (N, N): the population's own spikes of the step before
    b: Tensor  # (N)
    w_a: Tensor  # (N, 2N): weights of the time constant, N columns for d, then N for m
    b_a: Tensor  # (N)
    v_th: float = 0.5
    surrogate: Surrogate = "rectangular"
    surrogate_width: float = 1.0


class LTCState(NamedTuple):
    """State of a population of liquid time-constant neurons."""

    m: Tensor  # membrane potential after the reset (B, N)
    s: Tensor  # spikes (B, N)


def ltc_step(x: Tensor, state: LTCState, params: LTCParams) -> LTCState:
    """One time step of an LTC population; the returned state has its spikes s.

    Source: Yin 2023, the baseline LTC of NeuroVE, section IV-B.
    Differs: see the module.

    Args:
        x: input (B, I).
        state: state of the step before; zeros at the start.
        params: weights of the population.

    Raises:
        InvalidField: x is not I wide.
    """
    require_width("LTC", x, params.w_x.shape[1])
    d = linear(x, params.w_x, params.b) + linear(state.s, params.w_s)
    a = torch.sigmoid(linear(torch.cat((d, state.m), dim=-1), params.w_a, params.b_a))
    u = state.m + (d - state.m) * a
    s = spike(u - params.v_th, params.surrogate, params.surrogate_width)
    return LTCState(u * (1 - s.detach()), s)


class LTC(nn.Module):
    """A layer of N liquid time-constant spiking neurons, recurrent through its spikes, state in and out.

    Source: Yin 2023, as ltc_step.

    Args:
        inputs: I, width of the input.
        hidden: N, number of neurons.
        v_th: firing threshold; 0.5 is Yin's.
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
        """The weights for ltc_step."""
        return LTCParams(self.w_x, self.w_s, self.b, self.w_a, self.b_a, *self._constants)

    def initial_state(self, batch: int) -> LTCState:
        """The zero state."""
        zeros = self.w_x.new_zeros(batch, self.hidden)
        return LTCState(zeros, zeros)

    def forward(self, x: Tensor, state: LTCState) -> tuple[LTCState, LTCState]:
        """Scan a sequence: x (T, B, I) to the states of all steps, each field (T, B, N), and the last one.

        Raises:
            InvalidField: x is not a sequence of this width, or the state has another batch size.
        """
        params = self.params()
        require_sequence("LTC", x, params.w_x.shape[1], state, self.hidden)
        return scan_of(ltc_step, x, state, params)
