"""SLSTM: spiking LSTM cells (Henkes 2024), a baseline of the paper."""

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
    """What a layer of N spiking LSTM cells carries to the next step."""

    c: Tensor  # long-term memory (B, N)
    v: Tensor  # membrane potential (B, N), after the subtraction of the last spike, before that of this one
    s: Tensor  # spikes (B, N)


class SLSTMParams(NamedTuple):
    """Weights of one layer; rows of w_x, w_v and b are the input, forget, cell and output gate, as in ASLSTMParams."""

    w_x: Tensor  # (4N, I)
    w_v: Tensor  # (4N, N): the gates see the membrane potential
    b: Tensor  # (4N)
    v_th: Tensor | float  # one for all, or one per neuron (N)
    surrogate: Surrogate = "rectangular"
    surrogate_width: float = 1.0


def slstm_step(x: Tensor, state: SLSTMState, params: SLSTMParams) -> SLSTMState:
    """One time step of an SLSTM layer; the state that comes out holds its answer, spikes s and potentials v.

    Source: Henkes 2024, the baseline SLSTM of NeuroVE, section IV-B; gates i, f, g, o from x and v':
        c = sigmoid(f) c' + sigmoid(i) tanh(g);  h = sigmoid(o) tanh(c);  v = h - v_th s';  s = [v >= v_th]
    Differs: the gradient through the reset v_th s' is cut; snnTorch 1.0.0 begins from a zero state at every step
    where inputs and hidden sizes differ, this cell never does.

    Args:
        x: input (B, I).
        state: of the step before.
        params: of this layer.

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

    Args:
        inputs: I, width of the input.
        hidden: N, number of cells.
        v_th: firing threshold; h stays below 1, so a cell with a threshold of 1 or more never fires.
        surrogate: of the spike's gradient.
        surrogate_width: of the same.

    Raises:
        InvalidField: a value is out of its bound.
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
        """The layer's weights, for slstm_step."""
        return SLSTMParams(self.w_x, self.w_v, self.b, *self._constants)

    def initial_state(self, batch: int) -> SLSTMState:
        """Everything at rest."""
        zeros = self.w_x.new_zeros(batch, self.hidden)
        return SLSTMState(zeros, zeros, zeros)

    def forward(self, x: Tensor, state: SLSTMState) -> tuple[SLSTMState, SLSTMState]:
        """Scan a sequence: x (T, B, I) to the states of all steps, each field (T, B, N), and the last one.

        Raises:
            InvalidField: x is no sequence of this width, or the state is not of its batch.
        """
        params = self.params()
        require_sequence("SLSTM", x, params.w_x.shape[1], state, self.hidden)
        return scan_of(slstm_step, x, state, params)
