"""The paper's nonlinear regression and forecasting experiment (section IV-B): data, recipe, network, evaluation.

The data are 100 sine waves sin((i + d) / 20), i = 0 to 999, with random integer offsets d; 97 train, 3 validate. A
network reads one sample per step and predicts the next one (regression). Then it runs on its own predictions for 1000
more steps (forecast).
"""

import math
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from neurove_core.config import Config
from neurove_core.spiking.fused import recurrence
from neurove_core.spiking.fused.recurrence import Array, LayerWeights, State, Weights

LENGTH = 1000
VALIDATION = 3
SKIP = 100
"""Steps that the comparable regression figure omits: from the zero state, the phase is unknown at first."""

_WAVES, _PERIOD = 100, 20
_NO_ANSWER = 1e3  # error of a prediction that is not finite

KINDS = {
    "aslstm": recurrence.ASLSTM,
    "aslstm-wo": recurrence.ASLSTM,
    "slstm": recurrence.SLSTM,
    "ltc": recurrence.LTC,
}


class Recipe(Config):
    """How one model is built and trained. The training budget follows one rule for all models."""

    model: Literal["aslstm", "aslstm-wo", "slstm", "ltc"]
    hidden: int = Field(51, ge=1, le=1024)
    v_th: float = Field(1.0, gt=0, description="Firing threshold of most units, or its initial value if learned.")
    low_v_th: float | None = Field(None, gt=0, description="Threshold of the first `low_units` of each layer.")
    low_units: int = Field(0, ge=0)
    learn_v_th: bool = Field(False, description="Whether thresholds are learned, one per unit.")
    alpha: float = Field(0.5, ge=0, le=1)
    width: float = Field(0.25, gt=0, description="Width of the rectangular surrogate.")
    damping: float = Field(1.0, gt=0, le=1, description="Factor on the surrogate gradient.")
    diffusion: float = Field(0.5, description="Initial D in time and across layers.")
    batch: int = Field(16, ge=1)
    chunk: int = Field(100, ge=1, description="Steps of truncated backpropagation.")
    updates: int = Field(2500, ge=1, description="Teacher-forced updates.")
    lr: float = Field(1e-2, gt=0)
    lr_end: float = Field(2e-5, gt=0)
    fine_updates: int = Field(
        1000, ge=0, description="Updates of the second stage, by default 40 % of them in a closed loop."
    )
    fine_lr: float = Field(4e-4, gt=0)
    fine_lr_end: float = Field(2e-6, gt=0)
    closed_share: float = Field(0.4, ge=0, le=1)
    closed_steps: int = Field(700, ge=10, lt=LENGTH, description="Longest closed-loop window.")
    chosen_share: float = Field(
        0.4,
        ge=0,
        le=1,
        description="Final share of the fine updates from which the best weights are kept; 0: keep the last weights.",
    )
    rate: float = Field(0.0, ge=0, lt=1, description="Target spike rate of each layer; 0 for none.")
    rate_weight: float = Field(1.0, ge=0, description="Weight of a spike rate below the target, relative to the error.")
    clip: float = Field(0.5, gt=0, description="Largest norm of the gradient.")


class Evaluation(NamedTuple):
    """Errors and spike rates of a network; the lists have one number per validation wave, except `spike_rate`."""

    regression_rmse_x1000: list[float]  # all steps
    regression_rmse_x1000_from_100: list[float]
    forecast_rmse: list[float]
    spike_rate: list[float]  # per layer, over regression and forecast


def waves(seed: int = 2) -> NDArray[np.float32]:
    """The 100 sine waves (100, 1000); the first VALIDATION rows are for validation.

    The set-up is that of PyTorch's time_sequence_prediction example, which matches the paper's numbers.
    """
    offsets = np.random.default_rng(seed).integers(-4 * _PERIOD, 4 * _PERIOD, _WAVES)
    return np.sin((np.arange(LENGTH) + offsets[:, None]) / _PERIOD).astype(np.float32)


class Network:
    """A network whose weights are views into one vector, so that the optimiser works on one array.

    Args:
        recipe: defines the network.
        rng: draws the initial weights.
        dtype: float32 or float64.
    """

    def __init__(self, recipe: Recipe, rng: np.random.Generator, dtype: Any = np.float32) -> None:
        self.kind = KINDS[recipe.model]
        self.constants = recurrence.Constants(recipe.alpha, recipe.width, recipe.damping)
        self.theta, self.weights = _allocated(self.kind, recipe.hidden, dtype)
        self.grad, self._grads = _allocated(self.kind, recipe.hidden, dtype)
        self.learned = np.ones_like(self.theta, dtype=bool)
        self._initialise(recipe, rng)

    def _initialise(self, recipe: Recipe, rng: np.random.Generator) -> None:
        bound = recipe.hidden**-0.5
        self.theta[:] = rng.uniform(-bound, bound, self.theta.size)
        mask = _views(self.learned, _shapes(self.kind, recipe.hidden))
        pairs = ((self.weights.first, mask.first), (self.weights.second, mask.second))
        for layer, learned in pairs:
            diffuses = recipe.model == "aslstm"
            layer.d_time[:] = layer.d_space[:] = recipe.diffusion if diffuses else 0.0
            learned.d_time[:] = learned.d_space[:] = diffuses
            layer.v_th[:] = recipe.v_th
            if recipe.low_v_th is not None:
                layer.v_th[: recipe.low_units] = recipe.low_v_th
            learned.v_th[:] = recipe.learn_v_th
            layer.s_weight[:], learned.s_weight[:] = 1.0, False
        if recipe.model == "slstm":  # its readout reads potentials
            self.weights.second.s_weight[:] = 0.0
            self.weights.second.d_space[:] = 1.0
        self.weights.kappa[:] = math.log(0.2 / 0.8)  # the vector holds its logit

    def _real(self) -> Weights:
        return self.weights._replace(kappa=1 / (1 + np.exp(-self.weights.kappa)))

    def run(self, x: Array, state: State, free_from: int) -> recurrence.Tape:
        """Run the network over x (T, B) from a state; from step `free_from` on it runs on its own predictions."""
        return recurrence.forward(self.kind, self._real(), self.constants, x, state, free_from)

    def gradient(
        self, tape: recurrence.Tape, grad_y: Array, free_from: int, grad_s: tuple[float, float] = (0.0, 0.0)
    ) -> Array:
        """Gradient of the loss with respect to theta, of the same shape."""
        real = self._real()
        grads = recurrence.backward(self.kind, real, self.constants, tape, grad_y, free_from, grad_s)
        own = (*self._grads.first, *self._grads.second)
        for target, source in zip(own, (*grads.first, *grads.second), strict=True):
            target[...] = source
        self._grads.w_out[:], self._grads.b_out[:] = grads.w_out, grads.b_out
        self._grads.kappa[:] = grads.kappa * real.kappa * (1 - real.kappa)
        gradient: Array = self.grad * self.learned
        return gradient

    def initial_state(self, batch: int) -> State:
        """The zero state."""
        return recurrence.initial_state(batch, self.weights.w_out.size, self.theta.dtype)


def _shapes(kind: int, hidden: int) -> list[tuple[int, ...]]:
    """The shapes of all arrays of Weights, in order."""
    gates = {recurrence.ASLSTM: 5 * hidden, recurrence.SLSTM: 4 * hidden, recurrence.LTC: hidden}[kind]
    ltc = kind == recurrence.LTC

    def layer(inputs: int) -> list[tuple[int, ...]]:
        return [
            (inputs, gates),  # w_x
            (hidden, hidden if ltc else 4 * hidden),  # w_r
            (gates,),  # b
            (hidden,) if kind == recurrence.ASLSTM else (0,),  # d_time
            (2 * hidden, hidden) if ltc else (0, 0),  # w_a
            (hidden,) if ltc else (0,),  # b_a
            (hidden,),  # d_space
            (hidden,),  # v_th
            (1,),  # s_weight
        ]

    return [*layer(1), *layer(hidden), (hidden,), (1,), (1,)]


def _allocated(kind: int, hidden: int, dtype: Any) -> tuple[Array, Weights]:
    shapes = _shapes(kind, hidden)
    theta = np.zeros(sum(math.prod(shape) for shape in shapes), dtype)
    return theta, _views(theta, shapes)


def _views(vector: Array, shapes: list[tuple[int, ...]]) -> Weights:
    """Weights as views into a vector."""
    arrays: list[Array] = []
    start = 0
    for shape in shapes:
        arrays.append(vector[start : start + math.prod(shape)].reshape(shape))
        start += math.prod(shape)
    fields = len(LayerWeights._fields)
    return Weights(LayerWeights(*arrays[:fields]), LayerWeights(*arrays[fields : 2 * fields]), *arrays[2 * fields :])


def evaluate(network: Network, data: NDArray[np.float32] | None = None) -> tuple[Evaluation, Array]:
    """Regression over 999 teacher-forced steps, then 1000 steps of closed-loop forecast.

    Args:
        network: trained or untrained.
        data: (rows, 1000) waves; the default is the validation rows.

    Returns:
        the errors per row, and the predictions (1999, rows).
    """
    rows = waves()[:VALIDATION] if data is None else data
    truth = continued(rows)
    x = np.zeros((2 * LENGTH - 1, len(rows)), network.theta.dtype)
    x[: LENGTH - 1] = rows.T[:-1]
    x[LENGTH - 1] = rows.T[-1]
    tape = network.run(x, network.initial_state(len(rows)), LENGTH)
    answers = tape.y[1:]
    error = np.nan_to_num(answers - truth[1:], nan=_NO_ANSWER, posinf=_NO_ANSWER, neginf=-_NO_ANSWER)
    error = np.clip(error, -_NO_ANSWER, _NO_ANSWER).astype(np.float64)
    regression, forecast = error[: LENGTH - 1], error[LENGTH - 1 :]
    evaluation = Evaluation(
        regression_rmse_x1000=_rms(1000 * regression),
        regression_rmse_x1000_from_100=_rms(1000 * regression[SKIP:]),
        forecast_rmse=_rms(forecast),
        spike_rate=[float(layer.s[1:].mean()) for layer in tape[:2]],
    )
    return evaluation, answers


def continued(rows: NDArray[np.float32]) -> NDArray[np.float64]:
    """The waves (rows, 1000) continued to 2000 steps, (2000, rows), with the phase fitted to the rows."""
    i = np.arange(LENGTH) / _PERIOD
    basis = np.stack([np.sin(i), np.cos(i)], axis=1)
    weights, *_ = np.linalg.lstsq(basis, rows.T.astype(np.float64), rcond=None)
    j = np.arange(2 * LENGTH) / _PERIOD
    continued: NDArray[np.float64] = np.stack([np.sin(j), np.cos(j)], axis=1) @ weights
    return continued


def _rms(error: NDArray[np.float64]) -> list[float]:
    return [float(value) for value in np.sqrt((error**2).mean(axis=0))]
