"""Absolute bounds of sigma: an estimate with smaller sigmas is certain at any speed (decision 91)."""

from typing import Final, NamedTuple


class Bounds(NamedTuple):
    """Bounds of the sigma of both parts of a twist; None: not set, so that the next in line decides."""

    m_s: float | None = None  # of the linear part
    rad_s: float | None = None  # of the angular part

    def or_else(self, other: "Bounds") -> "Bounds":
        """These bounds, and those of another where they are not set.

        >>> Bounds(m_s=0.5).or_else(Bounds(0.2, 0.1))
        Bounds(m_s=0.5, rad_s=0.1)
        """
        return Bounds(*(own if own is not None else given for own, given in zip(self, other, strict=True)))


UNSET: Final = Bounds()
UNCERTAIN_M_S: Final = 0.2
UNCERTAIN_RAD_S: Final = 0.1
DEFAULT: Final = Bounds(UNCERTAIN_M_S, UNCERTAIN_RAD_S)
"""Where neither node nor bundle sets them."""
