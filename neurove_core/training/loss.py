"""The loss of the paper, L = L_a + L_l, with dynamic scaling between the angular and the linear part."""

from typing import NamedTuple

import torch
from torch import Tensor


class Balance(NamedTuple):
    """Running means of the two losses; the dynamic scaling divides by them."""

    linear: Tensor  # scalar, 0 before the first update
    angular: Tensor

    @classmethod
    def initial(cls) -> "Balance":
        """The balance before the first update."""
        return cls(torch.zeros(()), torch.zeros(()))


def group_loss(error: Tensor) -> Tensor:
    """Compute L_i: half the length of the error vector, averaged over all windows and bins.

    Source: NeuroVE, section III-D, Eq. (10): L_i = 1/2 sqrt(e_i^T e_i). Its gradient at e = 0 is taken as 0.

    Args:
        error: (..., 3), truth minus estimate, of the linear part [m/s] or the angular part [rad/s].

    >>> float(group_loss(torch.tensor([[3.0, 4.0, 0.0], [0.0, 0.0, 0.0]])))
    1.25
    """
    lengths: Tensor = torch.linalg.vector_norm(error, dim=-1)
    return 0.5 * lengths.mean()


def scaled_sum(linear: Tensor, angular: Tensor, balance: Balance, decay: float) -> tuple[Tensor, Balance]:
    """Compute L = L_l / m_l + L_a / m_a, where m_i is the running mean of L_i; the units of the parts cancel.

    Source: NeuroVE, section III-D, the dynamic scaling below Eq. (10), for which the paper gives no rule.
    Differs: this rule is ours. m <- decay m + (1 - decay) L, from the first loss on; no gradient passes through m.

    Args:
        linear: L_l.
        angular: L_a.
        balance: of the previous update.
        decay: of the running means, 0 to below 1.

    Returns:
        the loss to minimise, which stays about 2 while the network does not improve, and the new balance.
    """
    means = [
        torch.where(mean > 0, decay * mean + (1 - decay) * loss.detach(), loss.detach()).clamp_min(1e-12)
        for mean, loss in zip(balance, (linear, angular), strict=True)
    ]
    return linear / means[0] + angular / means[1], Balance(*means)
