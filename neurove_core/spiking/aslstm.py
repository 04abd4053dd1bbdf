"""ASLSTM, SLSTM and the readout: parameters, state, one step, and the same over a sequence (paper section III-C)."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from neurove_core.spiking.layers import (
    drawn_weights,
    require,
    require_sequence,
    require_shape_of_layer,
    require_threshold,
    scan_of,
)
from neurove_core.spiking.surrogate import Surrogate, spike


class ASLSTMState(NamedTuple):
    """What a layer of N cells carries to the next step."""

    c: Tensor  # long-term memory (B, N)
    v: Tensor  # membrane potential before the reset (B, N)
    s: Tensor  # spikes (B, N)


class ASLSTMParams(NamedTuple):
    """Weights of one layer; rows of w_x and b are the input, forget, cell, output gate, then f."""

    w_x: Tensor  # (5N, I)
    w_v: Tensor  # (4N, N): the gates see the membrane potential
    b: Tensor  # (5N)
    d_time: Tensor  # (N): diffusion from the same neuron one step ago; zeros without it
    alpha: float
    v_th: float
    surrogate: Surrogate = "rectangular"
    surrogate_width: float = 1.0


def aslstm_step(x: Tensor, state: ASLSTMState, params: ASLSTMParams) -> ASLSTMState:
    """One time step of an ASLSTM layer; the state that comes out holds its answer, spikes s and potentials v.

    Source: NeuroVE, Eq. (7) and (9):
        c = sigmoid(f) c' + sigmoid(i) tanh(g);  h = sigmoid(o) tanh(c)
        v = alpha (1 - s') h + f(x + J(t-1, t));  s = [v >= v_th]
    Differs: gates and f have a bias; J(t-1, t) = d_time v' is added beside f, for x and v differ in width (decision
    4); the gradient through the reset (1 - s') is cut.

    Args:
        x: input (B, I); for a layer above another, diffuse(s, v, D) of the one below.
        state: of the step before.
        params: of this layer.
    """
    from_x = torch.nn.functional.linear(x, params.w_x, params.b)
    width = state.c.shape[-1]
    gates = from_x[..., : 4 * width] + torch.nn.functional.linear(state.v, params.w_v)
    i, f, g, o = gates.chunk(4, dim=-1)
    c = torch.sigmoid(f) * state.c + torch.sigmoid(i) * torch.tanh(g)
    h = torch.sigmoid(o) * torch.tanh(c)
    v = params.alpha * (1 - state.s.detach()) * h + from_x[..., 4 * width :] + params.d_time * state.v
    return ASLSTMState(c, v, spike(v - params.v_th, params.surrogate, params.surrogate_width))


class ASLSTM(nn.Module):
    """One layer of N ASLSTM cells with learnable weights and per-neuron diffusion, state in and out.

    Args:
        inputs: I, width of the input.
        hidden: N, number of cells.
        alpha: share of h in the membrane, 0 to 1.
        v_th: firing threshold.
        diffusion: False gives the paper's ASLSTM-w/o: D = 0 everywhere.
        surrogate: of the spike's gradient.
        surrogate_width: of the same.

    Raises:
        InvalidField: a value is out of its bound.
    """

    d_time: Tensor

    def __init__(
        self,
        inputs: int,
        hidden: int,
        *,
        alpha: float = 0.9,
        v_th: float = 1.0,
        diffusion: bool = True,
        surrogate: Surrogate = "rectangular",
        surrogate_width: float = 1.0,
    ) -> None:
        super().__init__()
        require_shape_of_layer("ASLSTM", inputs=inputs, hidden=hidden)
        require(0 <= alpha <= 1, "ASLSTM", "alpha", alpha, "must be 0 to 1")
        require_threshold("ASLSTM", v_th, surrogate, surrogate_width)
        self.hidden = hidden
        self.w_x = drawn_weights(hidden, 5 * hidden, inputs)
        self.w_v = drawn_weights(hidden, 4 * hidden, hidden)
        self.b = drawn_weights(hidden, 5 * hidden)
        if diffusion:
            self.d_time = nn.Parameter(torch.full((hidden,), 0.2))
        else:
            self.register_buffer("d_time", torch.zeros(hidden), persistent=False)
        self._constants = (alpha, v_th, surrogate, surrogate_width)

    def params(self) -> ASLSTMParams:
        """The layer's weights, for aslstm_step."""
        return ASLSTMParams(self.w_x, self.w_v, self.b, self.d_time, *self._constants)

    def initial_state(self, batch: int) -> ASLSTMState:
        """Everything at rest."""
        zeros = self.w_x.new_zeros(batch, self.hidden)
        return ASLSTMState(zeros, zeros, zeros)

    def forward(self, x: Tensor, state: ASLSTMState) -> tuple[ASLSTMState, ASLSTMState]:
        """Scan a sequence: x (T, B, I) to the states of all steps, each field (T, B, N), and the last one.

        Raises:
            InvalidField: x is no sequence of this width, or the state is not of its batch.
        """
        params = self.params()
        require_sequence("ASLSTM", x, params.w_x.shape[1], state, self.hidden)
        return scan_of(aslstm_step, x, state, params)
