"""Training of a network of the sine experiment: chunks, closed loops, Adam, and selection of the best weights."""

import math
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from neurove_core.experiments.sine.data import LENGTH, SKIP, VALIDATION, Network, Recipe, waves
from neurove_core.spiking.fused import recurrence
from neurove_core.spiking.fused.recurrence import Array, State

_BETAS, _EPSILON = (0.9, 0.99), 1e-8
_LOG_FLOOR = 1e-9
_LEAST_V_TH = 0.02  # lower bound of learned thresholds
_CHECK_EVERY = 20  # fine updates between two checks of the closed loop
_CHECK_FROM, _CHECK_WAVES = 300, 16  # a check closes the loop at this step, on this number of training waves


class Adam:
    """Adam on one vector, with the gradient clipped by norm. Gradients that are not finite are skipped.

    Args:
        network: its theta is updated.
        clip: largest norm of a gradient.
    """

    def __init__(self, network: Network, clip: float) -> None:
        self._network, self._clip = network, clip
        self._m, self._v, self._count = np.zeros_like(network.theta), np.zeros_like(network.theta), 0
        self.skipped = 0

    def step(self, grad: Array, lr: float) -> None:
        """Update theta with one gradient."""
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
    """A trained network and the cost of its training."""

    network: Network
    updates: int
    cpu_s: float
    skipped_updates: int


def train(recipe: Recipe, seed: int, progress: Callable[[int, float], None] = lambda update, mse: None) -> Trained:
    """Train a network on the 97 training waves, in two stages.

    The first stage is teacher-forced: truncated backpropagation over chunks with carried state. The second stage mixes
    such chunks with closed-loop windows, whose gradient flows through the fed-back predictions. Its loss is log(mse),
    which puts the small one-step errors and the large closed-loop errors on one scale. Among the last weights, those
    with the smallest errors on training waves are kept.

    Args:
        recipe: defines network and training.
        seed: of weights and batches.
        progress: is called after each update with its number and mean square error.
    """
    rng = np.random.default_rng(seed)
    data = waves()[VALIDATION:].T.copy()  # (1000, 97)
    network = Network(recipe, rng)
    began = time.process_time()
    adam = Adam(network, recipe.clip)
    batches = _BatchStream(data, recipe, network, rng)
    for update in range(recipe.updates):
        x, target, state = batches.chunk()
        mse, grad, tape = _loss(network, recipe, x, target, state, len(x), log=False)
        batches.advance(tape)
        adam.step(grad, _rate(update, recipe.updates, recipe.lr, recipe.lr_end, warm_up=50))
        progress(update, mse)
    skipped = adam.skipped
    adam = Adam(network, recipe.clip)
    best = _Best(network, data)
    for update in range(recipe.fine_updates):
        lr = _rate(update, recipe.fine_updates, recipe.fine_lr, recipe.fine_lr_end, warm_up=20)
        closed = rng.random() < recipe.closed_share
        if closed:
            x, target, state = batches.window(_closed_steps(update, recipe, rng))
        else:
            x, target, state = batches.chunk()
        mse, grad, tape = _loss(network, recipe, x, target, state, 1 if closed else len(x), log=True)
        if not closed:
            batches.advance(tape)
        adam.step(grad, lr)
        left = recipe.fine_updates - 1 - update
        if left % _CHECK_EVERY == 0 and left < recipe.chosen_share * recipe.fine_updates:
            best.update()
        progress(recipe.updates + update, mse)
    best.restore()
    return Trained(network, recipe.updates + recipe.fine_updates, time.process_time() - began, skipped + adam.skipped)


class _Best:
    """The best weights so far on some training waves. One update may change the closed-loop error a lot.

    Args:
        network: its weights are compared and restored.
        data: (1000, rows) training waves.
    """

    def __init__(self, network: Network, data: Array) -> None:
        self._network, self._data = network, np.ascontiguousarray(data[:, :_CHECK_WAVES])
        self._score, self._theta = math.inf, network.theta.copy()

    def update(self) -> None:
        """Compare the current weights by the product of the teacher-forced and the closed-loop error."""
        x, target = self._data[:-1], self._data[1:]
        tape = self._network.run(x, self._network.initial_state(x.shape[1]), _CHECK_FROM)
        error = tape.y[1:] - target
        with np.errstate(over="ignore", invalid="ignore"):  # the error of a diverging network overflows
            regression = float(np.mean(error[SKIP:_CHECK_FROM].astype(np.float64) ** 2))
            forecast = float(np.mean(error[_CHECK_FROM:].astype(np.float64) ** 2))
        if regression * forecast < self._score:
            self._score, self._theta = regression * forecast, self._network.theta.copy()

    def restore(self) -> None:
        """Restore the best weights, if any were compared."""
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
    """Gradient per spike of scale * rate_weight * (missing share of the target rate)^2, for each layer."""
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
    return mse, grad, tape._replace(first=last.first, second=last.second)  # type: ignore[arg-type]  # only the last state is used


class _BatchStream:
    """A batch of random waves, read in chunks with carried state; at the end of the waves a new batch is drawn."""

    def __init__(self, data: Array, recipe: Recipe, network: Network, rng: np.random.Generator) -> None:
        self._data, self._recipe, self._network, self._rng = data, recipe, network, rng
        self._begin()

    def _begin(self) -> None:
        rows = self._rng.integers(0, self._data.shape[1], self._recipe.batch)
        self._batch = np.ascontiguousarray(self._data[:, rows])
        self._position, self._state = 0, self._network.initial_state(self._recipe.batch)
        self._visited = [(self._position, self._state)]

    def chunk(self) -> tuple[Array, Array, State]:
        """The inputs and targets of the next chunk, and the state before it."""
        if self._position >= LENGTH - 1:
            self._begin()
        return self._slice(self._position, self._recipe.chunk, self._state)

    def window(self, steps: int) -> tuple[Array, Array, State]:
        """A window of this many steps from the latest chunk boundary that allows it; the position stays."""
        position, state = next(place for place in reversed(self._visited) if place[0] + steps < LENGTH)
        return self._slice(position, steps, state)

    def _slice(self, position: int, steps: int, state: State) -> tuple[Array, Array, State]:
        end = min(position + steps, LENGTH - 1)
        return self._batch[position:end], self._batch[position + 1 : end + 1], state

    def advance(self, tape: recurrence.Tape) -> None:
        """Move to the end of the chunk that gave this tape."""
        first, second = tape.first, tape.second
        self._position += len(tape.y) - 1
        self._state = State(first, second, tape.y[-1].copy())  # type: ignore[arg-type]  # the layers of the tape are states here
        self._visited.append((self._position, self._state))
