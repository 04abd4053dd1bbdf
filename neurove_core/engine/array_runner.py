"""The Runner of a NeuroVE network that was read from a file: numpy and compiled code, without torch.

Answers equal those of `FastRunner` bit for bit, where that one runs over spike lists; widths that are no multiples of
LANES, which it computes dense, differ by rounding. Where the compiled kernels do not work, and inside `plain()`, the
same is computed in plain numpy.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.engine import array_folding, array_plain
from neurove_core.engine.array_folding import ArrayLayer
from neurove_core.engine.cells import flattened_weights, run_cells
from neurove_core.engine.choice import VARIABLE, Choice, fastest, pinned
from neurove_core.engine.fallback import reason_of, vectors_work, warn_once
from neurove_core.engine.spike_lists import SpikeList
from neurove_core.networks import tables
from neurove_core.networks.arrays import Array, ArrayState, Weights, map_sizes
from neurove_core.spiking.plain import is_plain

Counts = NDArray[np.uint8]
_TIMED: Final = 4  # windows that are timed
_Step = Callable[..., tuple[SpikeList, Array]]


class _Compiled(NamedTuple):
    """The compiled forms of extractor and projection."""

    first: _Step
    later: Sequence[_Step]
    project: Callable[[SpikeList], Array]


class Part(NamedTuple):
    """One step of a window, to be timed alone."""

    name: str
    run: Callable[[], object]
    sums: int  # multiplications with their additions, or additions of a weight, that it does
    weights: int  # size of the weights that it reads [bytes], each once


class ArrayRunner:
    """Runs windows of a network, several streams in one batch; see `Runner`.

    Answers to several streams equal those to each alone bit for bit.

    Args:
        weights: of the network, of kind neurove. They are copied into the layout of the compiled code.
    """

    def __init__(self, weights: Weights) -> None:
        self._config, net = weights.config, weights.config.network
        self._decay, self._v_th = np.float32(net.decay), np.float32(net.v_th)
        self._layers, self._projection = array_folding.convolutions(weights), array_folding.projection(weights)
        self._cells, self._readout = array_folding.cells(weights), array_folding.readout(weights)
        self._between = array_folding.between(weights)
        kappa = tables.sigmoid(float(weights.tensors["kappa_logit"]))
        self._constants = np.array([net.alpha, net.v_th, kappa], np.float32)
        self._flat = flattened_weights(None, self._cells, self._between, self._readout)
        self._sizes = map_sizes(weights.config)[1:]
        self._compiled = _compiled(self._layers, self._projection, net.encoding)
        self._spread = weights.spread
        self.choice = (
            Choice("sparse", "not timed") if self._compiled else Choice("plain", "no compiled form works here")
        )

    @property
    def is_compiled(self) -> bool:
        """Whether extractor and projection run in compiled code."""
        return self._compiled is not None

    def choose(self, windows: Counts | None) -> None:
        """Serve by the form that the environment names, else by the fastest one; every form gives the same answers.

        Args:
            windows: (T, C, H, W) network input of the windows to time; None where there are none.

        Raises:
            InvalidField: the environment names a form that there is not.
        """
        asked = pinned()
        if self._compiled is None:
            return
        forms = _forms(self._compiled, self._layers, self._config.network.encoding)
        if asked is not None:
            why = f"named by {VARIABLE}" if asked in forms else f"{VARIABLE}={asked} does not fit this model"
            self.choice = Choice(asked if asked in forms else "sparse", why)
        elif windows is None:
            self.choice = Choice("sparse", "the model has no golden windows to time")
        else:
            some = windows[:_TIMED]
            self.choice = fastest({name: partial(self._features, form, some) for name, form in forms.items()})
        self._compiled = forms[self.choice.form]

    def parts(self, counts: Counts) -> list[Part]:
        """The steps of a window after the zero state, in the form that serves; empty where no form is compiled.

        Args:
            counts: (C, H, W) network input.
        """
        if self._compiled is None:
            return []
        form, given, found = self._compiled, np.ascontiguousarray(counts)[None], []
        state, constants = self.initial_state(), (self._decay, self._v_th)
        layer, membrane = self._layers[0], state.membranes[0]
        found.append(
            Part(
                "first convolution",
                partial(form.first, given, membrane, *constants),
                membrane.size * layer.weight.size // layer.outputs,
                layer.weight.nbytes,
            )
        )
        spikes, _ = form.first(given, membrane, *constants)
        for number, (run, layer) in enumerate(zip(form.later, self._layers[1:], strict=True), 2):
            membrane = state.membranes[number - 1]
            sums = spikes.total * layer.outputs * 9 // 4  # a cell lies under 9 / 4 kernels of stride 2
            step = partial(run, spikes, membrane, *constants)
            found.append(Part(f"convolution {number}", step, sums, layer.weight.nbytes))
            spikes, _ = step()
        rows = form.project(spikes)
        sums, size = spikes.total * rows.size, self._projection.weight.itemsize
        found.append(Part("projection", partial(form.project, spikes), sums, sums * size))
        answer = partial(self._answer, rows[:, : self._config.network.features], state)
        return [*found, Part("cells and readout", answer, self._flat.size, self._flat.nbytes)]

    def _features(self, form: "_Compiled", windows: Counts) -> Array:
        """Currents of the projection and potentials of all blocks over consecutive windows, from the zero state."""
        membranes, found = list(self.initial_state().membranes), []
        for counts in windows:
            rows, membranes = self._over(form, np.ascontiguousarray(counts)[None], membranes)
            found += [rows, *membranes]
        return np.concatenate([part.reshape(-1) for part in found])

    def initial_state(self) -> ArrayState:
        """The zero state of one stream."""
        net = self._config.network
        maps = zip(self._layers, self._sizes, strict=True)
        membranes = tuple(np.zeros((1, *size, layer.outputs), np.float32) for layer, size in maps)
        cells = np.zeros((3 * net.cells, 1, net.hidden), np.float32)
        return ArrayState(membranes, cells, np.zeros((1, self._readout.bias.size), np.float32), net.channels)

    def log_sigma(self, state: ArrayState) -> NDArray[np.float64] | None:
        """Log sigma (6) of the window that led to a state; None without a spread."""
        if not self._spread:
            return None
        return state.readout[0, 6 * self._config.window.bins :].astype(np.float64)

    def run(
        self, counts: Sequence[Counts], states: Sequence[ArrayState]
    ) -> list[tuple[NDArray[np.float64], ArrayState]]:
        """One window of each stream; see `Runner.run`."""
        if len(counts) == 1:  # without a copy
            together, before = np.ascontiguousarray(counts[0])[None], list(states[0].membranes)
        else:
            together = np.stack(counts)
            before = [np.concatenate(maps) for maps in zip(*(state.membranes for state in states), strict=True)]
        extract = self._plainly if is_plain() or self._compiled is None else self._fast
        rows, after = extract(together, before)
        found = []
        for b, state in enumerate(states):
            twists, cells, y = self._answer(rows[b : b + 1, : self._config.network.features], state)
            # copied, because a view would keep the memory of all streams
            own = tuple(v[b : b + 1].copy() if len(states) > 1 else v for v in after)
            found.append((twists, ArrayState(own, cells, y, state.channels)))
        return found

    def _fast(self, counts: Counts, before: list[Array]) -> tuple[Array, list[Array]]:
        """Currents (B, F) of the projection, and the potentials of each block after the step."""
        assert self._compiled is not None
        return self._over(self._compiled, counts, before)

    def _over(self, form: "_Compiled", counts: Counts, before: list[Array]) -> tuple[Array, list[Array]]:
        spikes, v = form.first(counts, before[0], self._decay, self._v_th)
        after = [v]
        for layer, membrane in zip(form.later, before[1:], strict=True):
            spikes, v = layer(spikes, membrane, self._decay, self._v_th)
            after.append(v)
        return form.project(spikes), after

    def _plainly(self, counts: Counts, before: list[Array]) -> tuple[Array, list[Array]]:
        net = self._config.network
        table = tables.of_encoding(net.encoding)
        if net.precision == "int8":
            table = tables.codes_of(net.encoding).astype(np.float32)
        x: NDArray[np.generic] = table[counts.transpose(0, 2, 3, 1)]
        after = []
        for layer, membrane in zip(self._layers, before, strict=True):
            currents = array_plain.convolve(x.astype(np.float32), layer)
            x, v = array_plain.fire(currents, membrane, self._decay, self._v_th)
            after.append(v)
        return array_plain.project(x.astype(np.bool_), self._projection), after

    def _answer(self, rows: Array, state: ArrayState) -> tuple[NDArray[np.float64], Array, Array]:
        """Twists (n, 6), and the state of cells and readout after them."""
        cells, y = state.cells.copy(), state.readout.copy()
        if is_plain():
            given = self._cells, self._between, self._readout, self._constants
            answers = array_plain.run_cells(rows, *given, cells, y)[None]
        else:
            answers = np.empty((1, *y.shape), np.float32)
            run_cells(np.ascontiguousarray(rows), self._flat, 0, self._constants, cells, y, answers)
        bins = self._config.window.bins
        return answers[0, 0, : 6 * bins].reshape(bins, 6).astype(np.float64), cells, y


def _forms(sparse: _Compiled, layers: list[ArrayLayer], encoding: str) -> dict[str, _Compiled]:
    """All compiled forms of a network, by name; the usual one first."""
    from neurove_core.engine.array_fast import DenseLayer, WideFirstLayer, WideListLayer, is_exact

    forms = {"sparse": sparse, "dense": sparse._replace(later=[DenseLayer(layer) for layer in layers[1:]])}
    if layers[0].factor is not None and is_exact(layers):
        later = [WideListLayer(layer) for layer in layers[1:]]
        forms["float32"] = _Compiled(WideFirstLayer(layers[0], encoding), later, sparse.project)
    return forms


def _compiled(layers: list[ArrayLayer], projection: ArrayLayer, encoding: str) -> _Compiled | None:
    """The compiled forms where they work and equal plain numpy bit for bit, else None with one warning."""
    if not vectors_work():
        return None
    try:
        from neurove_core.engine.array_fast import FirstLayer, ListLayer, ListProjection, fits

        if not fits(layers, projection):
            return None
        first, later = FirstLayer(layers[0], encoding), [ListLayer(layer) for layer in layers[1:]]
        project = ListProjection(projection)
        if first.agrees() and all(layer.agrees() for layer in later) and project.agrees():
            return _Compiled(first, later, project)
        reason = "its results differ"
    except Exception as error:  # noqa: BLE001  # numba raises anything while it compiles
        reason = reason_of(error)
    warn_once("layers over spike lists", reason)
    return None
