"""The paper's nonlinear regression and forecasting experiment (section IV-B): data, training, evaluation of one model.

100 sine waves sin((i + d) / 20), i = 0 to 999, with random integer offsets d; 97 train, 3 validate. A network reads one
sample per step and answers the next one (regression). Then it runs on its own answers for 1000 more steps (forecast).
"""

import math
import time
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from neurove_core import recurrence
from neurove_core.config import Config
from neurove_core.recurrence import Array, LayerWeights, State, Weights

LENGTH = 1000
VALIDATION = 3
SKIP = 100
"""Steps left out of the comparable regression figure: from a zero state the first answer can not know the direction."""

_WAVES, _PERIOD = 100, 20
_BETAS, _EPSILON = (0.9, 0.99), 1e-8
_LOG_FLOOR = 1e-9
_LEAST_V_TH = 0.02  # of a learned threshold
_CHECK_EVERY = 20  # fine updates from one look at the closed loop to the next
_CHECK_FROM, _CHECK_WAVES = 300, 16  # and how: on its own answers from this step on, over so many training waves
_NO_ANSWER = 1e3  # error of an answer that is not finite

KINDS = {
    "aslstm": recurrence.ASLSTM,
    "aslstm-wo": recurrence.ASLSTM,
    "slstm": recurrence.SLSTM,
    "ltc": recurrence.LTC,
}


class Recipe(Config):
    """How one model is built and trained; the budget rule is the same for all."""

    model: Literal["aslstm", "aslstm-wo", "slstm", "ltc"]
    hidden: int = Field(51, ge=1, le=1024)
    v_th: float = Field(1.0, gt=0, description="Firing threshold of most units, or its start where it is learned.")
    low_v_th: float | None = Field(None, gt=0, description="Threshold of the first `low_units` of each layer.")
    low_units: int = Field(0, ge=0)
    learn_v_th: bool = Field(False, description="Whether thresholds are learned, one per unit.")
    alpha: float = Field(0.5, ge=0, le=1)
    width: float = Field(0.25, gt=0, description="Of the rectangular surrogate.")
    damping: float = Field(1.0, gt=0, le=1, description="Of the surrogate gradient.")
    diffusion: float = Field(0.5, description="Start of D in time and across layers.")
    batch: int = Field(16, ge=1)
    chunk: int = Field(100, ge=1, description="Steps of truncated backpropagation.")
    updates: int = Field(2500, ge=1, description="Teacher-forced updates.")
    lr: float = Field(1e-2, gt=0)
    lr_end: float = Field(2e-5, gt=0)
    fine_updates: int = Field(1000, ge=0, description="Updates of the second stage, 40 % of them in a closed loop.")
    fine_lr: float = Field(4e-4, gt=0)
    fine_lr_end: float = Field(2e-6, gt=0)
    closed_share: float = Field(0.4, ge=0, le=1)
    closed_steps: int = Field(700, ge=10, lt=LENGTH, description="Longest closed-loop window.")
    chosen_share: float = Field(
        0.4,
        ge=0,
        le=1,
        description="Share of the fine updates, the last, of whose weights the best are kept; 0: the last.",
    )
    rate: float = Field(0.0, ge=0, lt=1, description="Spike rate that each layer is held to; 0 for none.")
    rate_weight: float = Field(1.0, ge=0, description="Of a missing rate, relative to the error.")
    clip: float = Field(0.5, gt=0, description="Norm of the gradient.")


class Result(NamedTuple):
    """What a trained network reached; one number per validation wave."""

    regression_rmse_x1000: list[float]  # all steps
    regression_rmse_x1000_from_100: list[float]
    forecast_rmse: list[float]
    spike_rate: list[float]  # of the two layers, over regression and forecast


def waves(seed: int = 2) -> NDArray[np.float32]:
    """The 100 sine waves (100, 1000); the first VALIDATION rows validate.

    The set-up is that of PyTorch's time_sequence_prediction example, which the paper's numbers match.
    """
    offsets = np.random.default_rng(seed).integers(-4 * _PERIOD, 4 * _PERIOD, _WAVES)
    return np.sin((np.arange(LENGTH) + offsets[:, None]) / _PERIOD).astype(np.float32)


class Network:
    """Weights of a network as views into one vector, so that the optimiser is one line.

    Args:
        recipe: what is built.
        rng: draws the weights.
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
        mask = _cut(self.learned, _shapes(self.kind, recipe.hidden))
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
        if recipe.model == "slstm":  # its readout sees potentials
            self.weights.second.s_weight[:] = 0.0
            self.weights.second.d_space[:] = 1.0
        self.weights.kappa[:] = math.log(0.2 / 0.8)  # the vector holds its logit

    def _real(self) -> Weights:
        return self.weights._replace(kappa=1 / (1 + np.exp(-self.weights.kappa)))

    def run(self, x: Array, state: State, free_from: int) -> recurrence.Tape:
        """The network over x (T, B) from a state."""
        return recurrence.forward(self.kind, self._real(), self.constants, x, state, free_from)

    def gradient(
        self, tape: recurrence.Tape, grad_y: Array, free_from: int, grad_s: tuple[float, float] = (0.0, 0.0)
    ) -> Array:
        """Gradient of the loss by theta, (parameters)."""
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
        """Everything at rest."""
        return recurrence.initial_state(batch, self.weights.w_out.size, self.theta.dtype)


def _shapes(kind: int, hidden: int) -> list[tuple[int, ...]]:
    """Of all arrays of Weights, in order."""
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
    return theta, _cut(theta, shapes)


def _cut(vector: Array, shapes: list[tuple[int, ...]]) -> Weights:
    """Weights that are views of a vector."""
    arrays: list[Array] = []
    start = 0
    for shape in shapes:
        arrays.append(vector[start : start + math.prod(shape)].reshape(shape))
        start += math.prod(shape)
    fields = len(LayerWeights._fields)
    return Weights(LayerWeights(*arrays[:fields]), LayerWeights(*arrays[fields : 2 * fields]), *arrays[2 * fields :])


class Adam:
    """Adam on one vector, its gradient clipped by norm; an update that is not finite is left out.

    Args:
        network: whose theta it changes.
        clip: largest norm of a gradient.
    """

    def __init__(self, network: Network, clip: float) -> None:
        self._network, self._clip = network, clip
        self._m, self._v, self._count = np.zeros_like(network.theta), np.zeros_like(network.theta), 0
        self.skipped = 0

    def step(self, grad: Array, lr: float) -> None:
        """Change theta by one gradient."""
        norm = float(np.sqrt((grad.astype(np.float64) ** 2).sum()))
        if not math.isfinite(norm):
            self.skipped += 1
            return
        grad = grad * np.float32(min(1.0, self._clip / (norm + 1e-12)))
        self._count += 1
        first, second = _BETAS
        self._m += np.float32(1 - first) * (grad - self._m)
        self._v += np.float32(1 - second) * (grad * grad - self._v)
        m = self._m / np.float32(1 - first**self._count)
        v = self._v / np.float32(1 - second**self._count)
        self._network.theta -= np.float32(lr) * m / (np.sqrt(v) + np.float32(_EPSILON))
        for layer in self._network.weights[:2]:
            np.maximum(layer.v_th, np.float32(_LEAST_V_TH), out=layer.v_th)


class Trained(NamedTuple):
    """A training run."""

    network: Network
    updates: int
    cpu_s: float
    skipped_updates: int


def train(recipe: Recipe, seed: int, progress: Callable[[int, float], None] = lambda update, mse: None) -> Trained:
    """Train a network on the 97 training waves, in two stages.

    First teacher-forced, truncated backpropagation over chunks with carried state; then the same mixed with
    closed-loop windows, whose gradient goes through the fed-back answers, under log(mse), which puts the tiny one-step
    and the large closed-loop errors on one scale. Of the last weights, those are kept that do best on training waves.

    Args:
        recipe: what and how.
        seed: of weights and batches.
        progress: called after each update with its number and mean square error.
    """
    rng = np.random.default_rng(seed)
    data = waves()[VALIDATION:].T.copy()  # (1000, 97)
    network = Network(recipe, rng)
    began = time.process_time()
    adam = Adam(network, recipe.clip)
    walk = _Walk(data, recipe, network, rng)
    for update in range(recipe.updates):
        x, target, state = walk.chunk()
        mse, grad, tape = _loss(network, recipe, x, target, state, len(x), log=False)
        walk.advance(tape)
        adam.step(grad, _rate(update, recipe.updates, recipe.lr, recipe.lr_end, warm_up=50))
        progress(update, mse)
    skipped = adam.skipped
    adam = Adam(network, recipe.clip)
    best = _Best(network, data)
    for update in range(recipe.fine_updates):
        lr = _rate(update, recipe.fine_updates, recipe.fine_lr, recipe.fine_lr_end, warm_up=20)
        closed = rng.random() < recipe.closed_share
        if closed:
            x, target, state = walk.window(_closed_steps(update, recipe, rng))
        else:
            x, target, state = walk.chunk()
        mse, grad, tape = _loss(network, recipe, x, target, state, 1 if closed else len(x), log=True)
        if not closed:
            walk.advance(tape)
        adam.step(grad, lr)
        left = recipe.fine_updates - 1 - update
        if left % _CHECK_EVERY == 0 and left < recipe.chosen_share * recipe.fine_updates:
            best.look()
        progress(recipe.updates + update, mse)
    best.restore()
    return Trained(network, recipe.updates + recipe.fine_updates, time.process_time() - began, skipped + adam.skipped)


class _Best:
    """The weights that did best on some training waves: in a closed loop one update more may be much better or worse.

    Args:
        network: whose weights are watched.
        data: (1000, rows) training waves.
    """

    def __init__(self, network: Network, data: Array) -> None:
        self._network, self._data = network, np.ascontiguousarray(data[:, :_CHECK_WAVES])
        self._score, self._theta = math.inf, network.theta.copy()

    def look(self) -> None:
        """Compare the weights of now: the product of both errors, over _CHECK_FROM steps and from there on alone."""
        x, target = self._data[:-1], self._data[1:]
        tape = self._network.run(x, self._network.initial_state(x.shape[1]), _CHECK_FROM)
        error = tape.y[1:] - target
        with np.errstate(over="ignore", invalid="ignore"):  # a network that diverges is not the best
            regression = float(np.mean(error[SKIP:_CHECK_FROM].astype(np.float64) ** 2))
            forecast = float(np.mean(error[_CHECK_FROM:].astype(np.float64) ** 2))
        if regression * forecast < self._score:
            self._score, self._theta = regression * forecast, self._network.theta.copy()

    def restore(self) -> None:
        """Go back to them, if any were looked at."""
        if self._score < math.inf:
            self._network.theta[:] = self._theta


def _closed_steps(update: int, recipe: Recipe, rng: np.random.Generator) -> int:
    grown = min(1.0, update / (0.6 * recipe.fine_updates))
    longest = 10 + (recipe.closed_steps - 10) * grown
    return max(2, int(longest * rng.uniform(0.3, 1.0)))


def _rate(update: int, updates: int, high: float, low: float, warm_up: int) -> float:
    warm = min(1.0, (update + 1) / warm_up)
    return warm * (low + (high - low) * 0.5 * (1 + math.cos(math.pi * update / updates)))


def _rate_gradient(recipe: Recipe, tape: recurrence.Tape, scale: float) -> tuple[float, float]:
    """Gradient by one spike of scale * rate_weight * (how much of the rate is missing)^2, for each layer."""
    gradient = []
    for layer in tape[:2]:
        missing = max(0.0, 1 - float(layer.s[1:].mean()) / recipe.rate)
        gradient.append(-2 * scale * recipe.rate_weight * missing / recipe.rate / layer.s[1:].size)
    return gradient[0], gradient[1]


def _loss(
    network: Network, recipe: Recipe, x: Array, target: Array, state: State, free_from: int, *, log: bool
) -> tuple[float, Array, recurrence.Tape]:
    tape = network.run(x, state, free_from)
    error = tape.y[1:] - target
    mse = float(np.mean(error.astype(np.float64) ** 2))
    scale = 2 / error.size * (0.1 / (mse + _LOG_FLOOR) if log else 1.0)
    grad_s = _rate_gradient(recipe, tape, 0.1 if log else mse) if recipe.rate else (0.0, 0.0)
    last = recurrence.state_after(tape, len(x))
    grad = network.gradient(tape, (error * np.float32(scale)).astype(x.dtype), free_from, grad_s)
    return mse, grad, tape._replace(first=last.first, second=last.second)  # type: ignore[arg-type]  # only the end is used


class _Walk:
    """A batch of waves that is walked through in chunks, its state carried; at the end others are drawn."""

    def __init__(self, data: Array, recipe: Recipe, network: Network, rng: np.random.Generator) -> None:
        self._data, self._recipe, self._network, self._rng = data, recipe, network, rng
        self._begin()

    def _begin(self) -> None:
        rows = self._rng.integers(0, self._data.shape[1], self._recipe.batch)
        self._batch = np.ascontiguousarray(self._data[:, rows])
        self._position, self._state = 0, self._network.initial_state(self._recipe.batch)
        self._passed = [(self._position, self._state)]

    def chunk(self) -> tuple[Array, Array, State]:
        """The next inputs, targets, and the state before them."""
        if self._position >= LENGTH - 1:
            self._begin()
        return self._cut(self._position, self._recipe.chunk, self._state)

    def window(self, steps: int) -> tuple[Array, Array, State]:
        """So many steps from the newest place passed that leaves room for them, without going on."""
        position, state = next(place for place in reversed(self._passed) if place[0] + steps < LENGTH)
        return self._cut(position, steps, state)

    def _cut(self, position: int, steps: int, state: State) -> tuple[Array, Array, State]:
        end = min(position + steps, LENGTH - 1)
        return self._batch[position:end], self._batch[position + 1 : end + 1], state

    def advance(self, tape: recurrence.Tape) -> None:
        """Go on to the end of the chunk that gave this tape."""
        first, second = tape.first, tape.second
        self._position += len(tape.y) - 1
        self._state = State(first, second, tape.y[-1].copy())  # type: ignore[arg-type]  # layers are states by now
        self._passed.append((self._position, self._state))


def evaluate(network: Network, data: NDArray[np.float32] | None = None) -> tuple[Result, Array]:
    """Regression over 999 teacher-forced steps, then 1000 steps of closed-loop forecast.

    Args:
        network: trained or not.
        data: (rows, 1000) waves; the validation rows by default.

    Returns:
        figures per row, and the answers (1999, rows).
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
    result = Result(
        regression_rmse_x1000=_rms(1000 * regression),
        regression_rmse_x1000_from_100=_rms(1000 * regression[SKIP:]),
        forecast_rmse=_rms(forecast),
        spike_rate=[float(layer.s[1:].mean()) for layer in tape[:2]],
    )
    return result, answers


def continued(rows: NDArray[np.float32]) -> NDArray[np.float64]:
    """The waves over 2000 steps, (2000, rows): their phase is read off the rows."""
    i = np.arange(LENGTH) / _PERIOD
    basis = np.stack([np.sin(i), np.cos(i)], axis=1)
    weights, *_ = np.linalg.lstsq(basis, rows.T.astype(np.float64), rcond=None)
    j = np.arange(2 * LENGTH) / _PERIOD
    continued: NDArray[np.float64] = np.stack([np.sin(j), np.cos(j)], axis=1) @ weights
    return continued


def _rms(error: NDArray[np.float64]) -> list[float]:
    return [float(value) for value in np.sqrt((error**2).mean(axis=0))]
