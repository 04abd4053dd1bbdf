"""Roles: which model answers a stream, and which one runs in standby."""

from typing import NamedTuple

from neurove_core.estimator import Estimator


class Serving(NamedTuple):
    """A model at work, and the number of model changes up to it."""

    estimator: Estimator
    epoch: int


class Roles(NamedTuple):
    """Which models are at work on a stream."""

    serving: Serving
    standby: Serving | None = None
    probation: bool = False  # the standby model is the proven one: it takes over if the serving model fails
