"""LIF and ALIF: parameters, state, one step. State goes in and comes out.

Conventions of both: V_rest = 0; a spike is V >= v_th; the reset is hard (to 0) and is applied when the state is
stored, which is the same as the factor (1 - S) of the paper's next step. The gradient through the reset is cut.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from neurove_core.surrogate import Surrogate, spike


class LIFParams(NamedTuple):
    """Leaky integrate-and-fire: decay = 1 - dt/tau per step, threshold v_th, and the surrogate of its spike."""

    decay: float = 0.5
    v_th: float = 1.0
    surrogate: Surrogate = "rectangular"
    surrogate_width: float = 1.0


class LIFState(NamedTuple):
    """What a population of neurons carries to the next step."""

    v: Tensor  # membrane potential after the reset, dimensionless, any shape


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
    return fire(params.lif.decay * state.v + current + params.d_time * state.v, params.lif)


def diffuse(spikes: Tensor, v: Tensor, d: Tensor | float) -> Tensor:
    """X + D V: what the next layer receives, spikes and the potential that diffuses beside them (Eq. 2, 6a)."""
    return spikes + d * v


def lif_scan(currents: Tensor, state: LIFState, params: LIFParams) -> tuple[Tensor, LIFState]:
    """A LIF population over a sequence: currents (T, ...) to spikes (T, ...) and the last state."""
    spikes = []
    for current in currents:
        out, state = lif_step(current, state, params)
        spikes.append(out)
    return torch.stack(spikes), state
