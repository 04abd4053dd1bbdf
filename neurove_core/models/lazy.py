"""Fields of a bundle that are read from a file as arrays, and become torch objects when somebody asks for these.

A service needs the arrays alone, so it does not load torch. Training and experiments use the network and the tensors.
"""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from neurove_core.networks.arrays import Weights

if TYPE_CHECKING:
    from torch import Tensor

    from neurove_core.networks.kinds import Network


class _Field:
    """A field of a frozen dataclass whose value is converted at its first use.

    Args:
        owner: the dataclass.
        name: of the field; this object takes its place.
    """

    def __init__(self, owner: type, name: str) -> None:
        self._key = name
        setattr(owner, name, self)

    def __set__(self, instance: Any, value: Any) -> None:
        instance.__dict__[self._key] = value

    def stored(self, instance: Any) -> Any:
        """The value as it was given or, after its first use, converted."""
        return instance.__dict__[self._key]


class TensorField(_Field):
    """A tensor, given as such or as the array of its values."""

    def __get__(self, instance: Any, owner: type) -> "Tensor | TensorField":
        if instance is None:
            return self
        if isinstance(value := self.stored(instance), np.ndarray):
            import torch

            value = torch.from_numpy(value)
            instance.__dict__[self._key] = value
        return value  # type: ignore[no-any-return]  # a tensor, as given or just made


class NetworkField(_Field):
    """A network, given as such or as its weights."""

    def __get__(self, instance: Any, owner: type) -> "Network | NetworkField":
        if instance is None:
            return self
        if isinstance(value := self.stored(instance), Weights):
            from neurove_core.models.networks import network_of

            value = network_of(value)
            instance.__dict__[self._key] = (
                value  # it may be changed from now on, so the weights are no longer the truth
            )
        return value  # type: ignore[no-any-return]  # a network, as given or just made


def as_array(value: Any) -> NDArray[Any]:
    """A stored value as an array; of a tensor, a view of its memory."""
    return value if isinstance(value, np.ndarray) else value.detach().numpy()
