"""LIF neurons: parameters, state, one step, and a module that scans a sequence. State goes in and comes out.

    v = decay v' + current          membrane potential before the reset; decay = 1 - dt/tau
    s = [v >= v_th]                 spike, 0 or 1
    v <- v (1 - s)                  hard reset to V_rest = 0; this v is the state

Source: NeuroVE, Eq. (1): tau dV/dt = -(V - V_rest) + R I, V = V_rest if V > V_th; its Euler step is Eq. (4) and (5)
with J = 0: V(t+1) = (1 - dt/tau) V(t) + dt/tau R I(t). Wu 2018.
Differs: dt/tau R is part of the current, as in Eq. (6a). A spike is v >= v_th, as in Eq. (6c), where Eq. (1) has >. The
reset is applied when the state is stored, which equals the factor (1 - S) in the next step of Eq. (6a). No gradient
flows through the reset. ALIF and LTC use the same conventions.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from neurove_core.spiking.fused import scan
from neurove_core.spiking.layers import require, require_sequence, require_shape_of_layer, require_threshold
from neurove_core.spiking.plain import is_plain
from neurove_core.spiking.surrogate import Surrogate, spike


class LIFParams(NamedTuple):
    """Constants of a LIF population: decay = 1 - dt/tau per step, threshold v_th, and the surrogate of its spike."""

    decay: float = 0.5
    v_th: float = 1.0
    surrogate: Surrogate = "rectangular"
    surrogate_width: float = 1.0


class LIFState(NamedTuple):
    """State of a population of neurons."""

    v: Tensor  # membrane potential after the reset, dimensionless, any shape


class NeuronSteps(NamedTuple):
    """Spikes and potentials of a population in each step of a sequence."""

    s: Tensor  # spikes of 0 and 1 (T, B, N)
    v: Tensor  # membrane potential before the reset (T, B, N); it may diffuse into the next layer


def fire(v: Tensor, params: LIFParams) -> tuple[Tensor, LIFState]:
    """Spikes s = [v >= v_th], and the state v (1 - s)."""
    spikes = spike(v - params.v_th, params.surrogate, params.surrogate_width)
    return spikes, LIFState(v * (1 - spikes.detach()))


def lif_step(current: Tensor, state: LIFState, params: LIFParams) -> tuple[Tensor, LIFState]:
    """One time step of a LIF population: leak, integrate, fire, reset.

    Source: NeuroVE, Eq. (1), Euler step as Eq. (4) with J = 0; Wu 2018.
    Differs: see the module.

    Args:
        current: input of this step, any shape.
        state: from the step before; zeros at the start.
        params: constants of the population.

    Returns:
        spikes of 0 and 1 in the shape of `current`, and the next state.
    """
    return fire(params.decay * state.v + current, params)


def lif_scan(currents: Tensor, state: LIFState, params: LIFParams) -> tuple[Tensor, LIFState]:
    """A LIF population over a sequence: currents (T, ...) to spikes (T, ...) and the last state.

    On a CPU this is one compiled pass over all steps (fused/scan.py); otherwise, or inside `plain()`, it is
    `lif_scan_reference`. Spikes and state are equal bit for bit.
    """
    if currents.dtype in (torch.bfloat16, torch.float16) and state.v.dtype == torch.float32:
        currents = currents.float()  # autocast keeps maps in half precision; a sum with the potentials is float32
    if not is_plain() and scan.fits(currents, state.v):
        spikes, v = scan.scan(currents, state.v, params.decay, params.v_th, params.surrogate_width, params.surrogate)
        return spikes, LIFState(v)
    return lif_scan_reference(currents, state, params)


def lif_scan_reference(currents: Tensor, state: LIFState, params: LIFParams) -> tuple[Tensor, LIFState]:
    """The reference implementation of lif_scan: one lif_step after the other."""
    spikes = []
    for current in currents:
        out, state = lif_step(current, state, params)
        spikes.append(out)
    return torch.stack(spikes), state


class LIF(nn.Module):
    """A population of N LIF neurons without weights, state in and out; its input is the current of each neuron.

    Source: NeuroVE, Eq. (1) and (4), as lif_step.

    Args:
        hidden: N, number of neurons.
        decay: 1 - dt/tau per step, 0 (no memory) to below 1.
        v_th: firing threshold.
        surrogate: kind of the spike's surrogate gradient.
        surrogate_width: width of the surrogate, in units of the potential.

    Raises:
        InvalidField: a value is out of its bounds.

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
        self.register_buffer("_origin", torch.zeros(()), persistent=False)  # follows the module's dtype and device

    def params(self) -> LIFParams:
        """The constants for lif_step."""
        return self._params

    def initial_state(self, batch: int) -> LIFState:
        """The zero state."""
        return LIFState(self._origin.new_zeros(batch, self.hidden))

    def forward(self, x: Tensor, state: LIFState) -> tuple[NeuronSteps, LIFState]:
        """Scan a sequence: currents (T, B, N) to spikes and potentials of all steps, and the last state.

        Raises:
            InvalidField: x is not a sequence of this width, or the state has another batch size.
        """
        require_sequence("LIF", x, self.hidden, state, self.hidden)
        spikes, potentials = [], []
        for current in x:
            v = self._params.decay * state.v + current
            s, state = fire(v, self._params)
            spikes.append(s)
            potentials.append(v)
        return NeuronSteps(torch.stack(spikes), torch.stack(potentials)), state


def lif_params(what: str, decay: float, v_th: float, surrogate: Surrogate, surrogate_width: float) -> LIFParams:
    """Checked LIF parameters of a neuron; `what` names it in errors."""
    require(0 <= decay < 1, what, "decay", decay, "must be at least 0 and below 1")
    require_threshold(what, v_th, surrogate, surrogate_width)
    return LIFParams(decay, v_th, surrogate, surrogate_width)
