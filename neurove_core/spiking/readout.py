"""The output neurons O: a leaky membrane without a reset, whose potential is the network's output.

    y = kappa y' + f(z),  z = x + J,  0 < kappa < 1         f is linear; z comes from alif.diffuse

Source: NeuroVE, Eq. (8): O(v, x) = kappa v + f(x + J(t-1, t)).
Differs: v of the equation is the output neuron's own potential y', read at every step (decision 4).
"""

import math

import torch
from torch import Tensor, nn

from neurove_core.spiking.fused import aslstm as fused
from neurove_core.spiking.layers import require, require_sequence, require_shape_of_layer
from neurove_core.spiking.plain import is_plain


def readout_step(z: Tensor, y: Tensor, weight: Tensor, bias: Tensor, kappa: Tensor | float) -> Tensor:
    """One time step of the output neurons.

    Source: NeuroVE, Eq. (8).
    Differs: see the module (decision 4).

    Args:
        z: spikes plus diffusing potential of the layer below (B, N).
        y: potential of the step before (B, K).
        weight: (K, N).
        bias: (K).
        kappa: leak per step.

    Returns:
        potential of this step (B, K).
    """
    return kappa * y + torch.nn.functional.linear(z, weight, bias)


def readout_scan(z: Tensor, y: Tensor, weight: Tensor, bias: Tensor, kappa: Tensor) -> tuple[Tensor, Tensor]:
    """The output neurons over a sequence z (T, B, N): potentials of all steps (T, B, K), and the last one.

    Where gradients are recorded on a CPU, this is one compiled pass (fused/aslstm.py); otherwise, or inside `plain()`,
    it is one `readout_step` after the other. Potentials are equal bit for bit.
    """
    if not is_plain() and fused.fits(z, y, weight, bias, kappa):
        answers = fused.leaky_sums(fused.applied(z, weight, bias), y, kappa)
        return answers, answers[-1]
    steps = []
    for z_t in z:
        y = readout_step(z_t, y, weight, bias, kappa)
        steps.append(y)
    return torch.stack(steps), y


class Readout(nn.Module):
    """K output neurons O with learnable weights and one learnable leak kappa = sigmoid(kappa_logit).

    Source: NeuroVE, Eq. (8), as readout_step.

    Args:
        inputs: N, width of the layer below.
        outputs: K.
        kappa: initial leak per step, between 0 and 1.

    Raises:
        InvalidField: a value is out of its bounds.
    """

    def __init__(self, inputs: int, outputs: int, *, kappa: float = 0.2) -> None:
        super().__init__()
        require_shape_of_layer("Readout", inputs=inputs, outputs=outputs)
        require(0 < kappa < 1, "Readout", "kappa", kappa, "must be above 0 and below 1")
        self.f = nn.Linear(inputs, outputs)
        self.kappa_logit = nn.Parameter(torch.tensor(math.log(kappa / (1 - kappa))))

    @property
    def kappa(self) -> Tensor:
        """The leak per step, between 0 and 1 for any value of its logit."""
        return torch.sigmoid(self.kappa_logit)

    def initial_state(self, batch: int) -> Tensor:
        """Zero potentials (B, K)."""
        return self.f.weight.new_zeros(batch, self.f.out_features)

    def forward(self, z: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Scan a sequence: z = diffuse(s, v, D) of the layer below (T, B, N) to potentials (T, B, K), and the last one.

        Raises:
            InvalidField: z is not a sequence of this width, or y has another batch size.
        """
        require_sequence("Readout", z, self.f.in_features, (y,), self.f.out_features)
        return readout_scan(z, y, self.f.weight, self.f.bias, self.kappa)
