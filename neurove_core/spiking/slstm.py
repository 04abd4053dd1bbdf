"""SLSTM: spiking LSTM cells, a baseline of the paper.

    i, f, g, o = W_x x + W_v v' + b                                   input of the gates
    c = sigmoid(f) c' + sigmoid(i) tanh(g);  h = sigmoid(o) tanh(c)   long-term memory, hidden value
    v = h - v_th s'                                                   membrane potential
    s = [v >= v_th]                                                   spike

Source: Henkes 2024, the baseline SLSTM of NeuroVE, section IV-B.
Differs: no gradient flows through the reset v_th s'. snnTorch 1.0.0 starts from a zero state at every step where inputs
and hidden sizes differ; this cell never does.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from neurove_core.spiking.layers import (
    drawn_weights,
    require_sequence,
    require_shape_of_layer,
    require_threshold,
    require_width,
    scan_of,
)
from neurove_core.spiking.surrogate import Surrogate, spike


class SLSTMState(NamedTuple):
    """State of a layer of N spiking LSTM cells."""

    c: Tensor  # long-term memory (B, N)
    v: Tensor  # membrane potential (B, N), after the last spike is subtracted and before this one is
    s: Tensor  # spikes (B, N)


class SLSTMParams(NamedTuple):
    """Weights of one layer; rows of w_x, w_v and b are input, forget, cell and output gate, as in ASLSTMParams."""

    w_x: Tensor  # (4N, I)
    w_v: Tensor  # (4N, N): from the membrane potential to the gates
    b: Tensor  # (4N)
    v_th: Tensor | float  # one for all, or one per neuron (N)
    surrogate: Surrogate = "rectangular"
    surrogate_width: float = 1.0


def slstm_step(x: Tensor, state: SLSTMState, params: SLSTMParams) -> SLSTMState:
    """One time step of an SLSTM layer; the returned state has its output, spikes s and potentials v.

    Source: Henkes 2024, the baseline SLSTM of NeuroVE, section IV-B.
    Differs: see the module.

    Args:
        x: input (B, I).
        state: state of the step before.
        params: weights of this layer.

    Raises:
        InvalidField: x is not I wide.
    """
    require_width("SLSTM", x, params.w_x.shape[1])
    gates = torch.nn.functional.linear(x, params.w_x, params.b) + torch.nn.functional.linear(state.v, params.w_v)
    i, f, g, o = gates.chunk(4, dim=-1)
    c = torch.sigmoid(f) * state.c + torch.sigmoid(i) * torch.tanh(g)
    v = torch.sigmoid(o) * torch.tanh(c) - params.v_th * state.s.detach()
    return SLSTMState(c, v, spike(v - params.v_th, params.surrogate, params.surrogate_width))


class SLSTM(nn.Module):
    """One layer of N spiking LSTM cells with learnable weights, state in and out.

    Source: Henkes 2024, as slstm_step.

    Args:
        inputs: I, width of the input.
        hidden: N, number of cells.
        v_th: firing threshold; h stays below 1, so a cell with a threshold of 1 or more never fires.
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
        v_th: float = 0.1,
        surrogate: Surrogate = "rectangular",
        surrogate_width: float = 1.0,
    ) -> None:
        super().__init__()
        require_shape_of_layer("SLSTM", inputs=inputs, hidden=hidden)
        require_threshold("SLSTM", v_th, surrogate, surrogate_width)
        self.hidden = hidden
        self.w_x = drawn_weights(hidden, 4 * hidden, inputs)
        self.w_v = drawn_weights(hidden, 4 * hidden, hidden)
        self.b = drawn_weights(hidden, 4 * hidden)
        self._constants = (v_th, surrogate, surrogate_width)

    def params(self) -> SLSTMParams:
        """The weights for slstm_step."""
        return SLSTMParams(self.w_x, self.w_v, self.b, *self._constants)

    def initial_state(self, batch: int) -> SLSTMState:
        """The zero state."""
        zeros = self.w_x.new_zeros(batch, self.hidden)
        return SLSTMState(zeros, zeros, zeros)

    def forward(self, x: Tensor, state: SLSTMState) -> tuple[SLSTMState, SLSTMState]:
        """Scan a sequence: x (T, B, I) to the states of all steps, each field (T, B, N), and the last one.

        Raises:
            InvalidField: x is not a sequence of this width, or the state has another batch size.
        """
        params = self.params()
        require_sequence("SLSTM", x, params.w_x.shape[1], state, self.hidden)
        return scan_of(slstm_step, x, state, params)
