"""ASLSTM, SLSTM and the readout: parameters, state, one step, and the same over a sequence (paper section III-C)."""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

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


def readout_step(z: Tensor, y: Tensor, weight: Tensor, bias: Tensor, kappa: Tensor | float) -> Tensor:
    """The output neurons O: a leaky membrane without a reset, whose potential is the answer.

    Source: NeuroVE, Eq. (8): y = kappa y' + f(x + J), 0 < kappa < 1, with z = x + J from diffuse.
    Differs: v of the equation is the output neuron's own potential y', read at every step (decision 4).

    Args:
        z: (B, N).
        y: potential of the step before (B, K).
        weight: (K, N).
        bias: (K).
        kappa: leak per step.
    """
    return kappa * y + torch.nn.functional.linear(z, weight, bias)


class Readout(nn.Module):
    """K output neurons O with learnable weights and one learnable leak kappa = sigmoid(kappa_logit).

    Source: NeuroVE, Eq. (8), as readout_step.

    Args:
        inputs: N, width of the layer below.
        outputs: K.
        kappa: initial leak per step, between 0 and 1.

    Raises:
        InvalidField: a value is out of its bound.
    """

    def __init__(self, inputs: int, outputs: int, *, kappa: float = 0.2) -> None:
        super().__init__()
        require_shape_of_layer("Readout", inputs=inputs, outputs=outputs)
        require(0 < kappa < 1, "Readout", "kappa", kappa, "must be above 0 and below 1")
        self.f = nn.Linear(inputs, outputs)
        self.kappa_logit = nn.Parameter(torch.tensor(math.log(kappa / (1 - kappa))))

    @property
    def kappa(self) -> Tensor:
        """The leak per step, between 0 and 1 whatever the training does to its logit."""
        return torch.sigmoid(self.kappa_logit)

    def initial_state(self, batch: int) -> Tensor:
        """Potentials at rest (B, K)."""
        return self.f.weight.new_zeros(batch, self.f.out_features)

    def forward(self, z: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Scan a sequence: z = diffuse(s, v, D) of the layer below (T, B, N) to potentials (T, B, K), and the last.

        Raises:
            InvalidField: z is no sequence of this width, or y is not of its batch.
        """
        require_sequence("Readout", z, self.f.in_features, (y,), self.f.out_features)
        kappa, answers = self.kappa, []
        for z_t in z:
            y = readout_step(z_t, y, self.f.weight, self.f.bias, kappa)
            answers.append(y)
        return torch.stack(answers), y
