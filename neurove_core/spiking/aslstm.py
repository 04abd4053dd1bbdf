"""ASLSTM cells: spiking LSTM cells whose output stage is an ALIF neuron.

    i, f, g, o = W_x x + W_v v' + b                                   input of the gates
    c = sigmoid(f) c' + sigmoid(i) tanh(g);  h = sigmoid(o) tanh(c)   long-term memory, hidden value
    v = alpha (1 - s') h + f(x) + d_time v'                           membrane potential; f(x) is linear
    s = [v >= v_th]                                                   spike

Source: NeuroVE, section III-C, Eq. (7) and (9): A(h, x, v') = alpha (1 - s') h + f(x + J(t-1, t)).
Differs: gates and f have a bias. J(t-1, t) = d_time v' is added outside f, because x and v differ in width (decision
4). No gradient flows through the reset (1 - s').
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from neurove_core.spiking.fused import aslstm as fused
from neurove_core.spiking.layers import (
    drawn_weights,
    require,
    require_sequence,
    require_shape_of_layer,
    require_threshold,
    scan_of,
)
from neurove_core.spiking.plain import is_plain
from neurove_core.spiking.surrogate import Surrogate, spike


class ASLSTMState(NamedTuple):
    """State of a layer of N cells."""

    c: Tensor  # long-term memory (B, N)
    v: Tensor  # membrane potential before the reset (B, N)
    s: Tensor  # spikes (B, N)


class ASLSTMParams(NamedTuple):
    """Weights of one layer; the rows of w_x and b are input, forget, cell and output gate, then f."""

    w_x: Tensor  # (5N, I)
    w_v: Tensor  # (4N, N): from the membrane potential to the gates
    b: Tensor  # (5N)
    d_time: Tensor  # (N): diffusion from the same neuron one step ago; zeros without diffusion
    alpha: float
    v_th: float
    surrogate: Surrogate = "rectangular"
    surrogate_width: float = 1.0


def aslstm_step(x: Tensor, state: ASLSTMState, params: ASLSTMParams) -> ASLSTMState:
    """One time step of an ASLSTM layer; the returned state has its output, spikes s and potentials v.

    Source: NeuroVE, Eq. (7) and (9).
    Differs: see the module (decision 4).

    Args:
        x: input (B, I); for a layer above another, diffuse(s, v, D) of the one below.
        state: state of the step before.
        params: weights of this layer.
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
    """One layer of N ASLSTM cells with learnable weights and diffusion per neuron, state in and out.

    Source: NeuroVE, Eq. (7) and (9), as aslstm_step.

    Args:
        inputs: I, width of the input.
        hidden: N, number of cells.
        alpha: share of h in the membrane, 0 to 1.
        v_th: firing threshold.
        diffusion: False gives the paper's ASLSTM-w/o: D = 0 everywhere.
        surrogate: kind of the spike's surrogate gradient.
        surrogate_width: width of the surrogate, in units of the potential.

    Raises:
        InvalidField: a value is out of its bounds.
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
        """The weights for aslstm_step."""
        return ASLSTMParams(self.w_x, self.w_v, self.b, self.d_time, *self._constants)

    def initial_state(self, batch: int) -> ASLSTMState:
        """The zero state."""
        zeros = self.w_x.new_zeros(batch, self.hidden)
        return ASLSTMState(zeros, zeros, zeros)

    def forward(self, x: Tensor, state: ASLSTMState) -> tuple[ASLSTMState, ASLSTMState]:
        """Scan a sequence: x (T, B, I) to the states of all steps, each field (T, B, N), and the last one.

        Where gradients are recorded on a CPU, this is one compiled pass (fused/aslstm.py).

        Raises:
            InvalidField: x is not a sequence of this width, or the state has another batch size.
        """
        params = self.params()
        require_sequence("ASLSTM", x, params.w_x.shape[1], state, self.hidden)
        weights = params.w_x, params.w_v, params.b, params.d_time
        if is_plain() or not fused.fits(x, *state, *weights):
            return scan_of(aslstm_step, x, state, params)
        alpha, *spike = self._constants
        steps = ASLSTMState(*fused.scan(x, state, weights, alpha, tuple(spike)))
        return steps, ASLSTMState(*(field[-1] for field in steps))
