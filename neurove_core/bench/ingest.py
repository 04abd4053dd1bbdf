"""Benchmarks from events to counts, from events to an estimate, and from the words of a camera to events."""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray

from neurove_core import sources
from neurove_core.bench import Row, interleaved, peers, rows, window
from neurove_core.compiled import compiled
from neurove_core.config import ModelConfig
from neurove_core.estimator import Estimator
from neurove_core.geometry.camera import lookup_table
from neurove_core.ingest.counting import count_events, count_events_reference
from neurove_core.models import bundle
from neurove_core.networks.encoding import to_spikes_reference
from neurove_core.networks.neurove import NeuroVE
from neurove_core.spiking.plain import plain
from neurove_protocol import Events, Sensor

SENSOR = Sensor(346, 260)
BINS, DURATION_US = 10, 50_000


def ingest(rounds: int, missing: peers.Missing, *, quick: bool, with_peers: bool) -> list[Row]:
    """Events of one window to counts (2n, H, W) of a DAVIS346. The limit is adding to cells that are already known."""
    found: list[Row] = []
    for n in (5_000,) if quick else (100_000, 1_000_000):
        events = sweeping_edge(n)
        known = _cells(events)
        runs: dict[str, Callable[[], Any]] = {
            "ours": _counted(count_events, events),
            "numpy": _counted(count_events_reference, events),
        }
        if with_peers:
            runs |= _counting_peers(events, missing)
        expected = runs["ours"]()
        equal: dict[str, bool | None] = {
            name: bool(np.array_equal(np.minimum(run(), 255), expected)) for name, run in runs.items() if name != "ours"
        }
        if "tonic" in equal:
            equal["tonic"] = None  # its bins end at other times, and it drops the last events
        times = interleaved({**runs, "limit": _increments(known)}, rounds)
        found += rows(f"ingest {n:.0e} events, 346x260, n=10", times, equal, times["limit"])
    return found


def _counted(count: Callable[..., int], events: Events) -> Callable[[], NDArray[np.uint8]]:
    pixels = np.arange(SENSOR.height * SENSOR.width, dtype=np.int32).reshape(SENSOR.height, SENSOR.width)
    pixels.setflags(write=False)  # as lookup_table returns it

    def run() -> NDArray[np.uint8]:
        into = np.zeros((2 * BINS, SENSOR.height, SENSOR.width), np.uint8)
        count(events, 0, DURATION_US // BINS, pixels, into)
        return into

    return run


def _increments(known: NDArray[np.uint32]) -> Callable[[], None]:
    """Adds to known cells: the part of counting that cannot be avoided."""

    def run() -> None:
        _increment(known, np.zeros(2 * BINS * SENSOR.height * SENSOR.width, np.uint8))

    return run


def end_to_end(rounds: int, missing: peers.Missing, *, quick: bool, with_peers: bool) -> list[Row]:
    """Events of one window to its estimate: 1e5 events of a DAVIS346, from the zero state."""
    found: list[Row] = []
    shapes = {"tiny": window.TINY} if quick else {"shipped": window.SHIPPED, "reference, T=1": window.REFERENCE}
    events = sweeping_edge(5_000 if quick else 100_000)
    tonic = peers.load("tonic.functional", missing) if with_peers else None
    for name, config in shapes.items():
        estimator = Estimator(bundle.untrained(0, config))
        network = cast("NeuroVE", estimator.bundle.network)
        others = peers.networks(network, missing) if with_peers else {}
        narrow = Estimator(bundle.untrained(0, window.with_precision(config, "int8")))
        runs: dict[str, Callable[[], Any]] = {"ours": _estimated(estimator, events)}
        runs["ours, int8"] = _estimated(narrow, events)
        for peer, theirs in {"PyTorch, plain": network, **others}.items():
            runs[f"numpy and {peer}"] = _in_steps(_numpy_counts(config, events), theirs)
        if tonic is not None and "snnTorch" in others:
            runs["tonic and snnTorch"] = _in_steps(_tonic_counts(tonic, config, events), others["snnTorch"])
        expected = runs["ours"]()
        equal: dict[str, bool | None] = {
            peer: None
            if any(name in peer for name in peers.DIFFERENT_BY_DESIGN)
            else bool(np.allclose(run(), expected, rtol=1e-3, atol=1e-4))
            for peer, run in runs.items()
            if not peer.startswith("ours")
        }
        times, title = interleaved(runs, rounds), f"events to estimate, {events.n:.0e} events, {name}"
        found += rows(title, times, equal)
        in_int8 = {**times, "ours": times.pop("ours, int8"), "ours, float32": times["ours"]}
        found += rows(f"{title}, int8", in_int8, dict.fromkeys([*equal, "ours, float32"]))
    return found


def _estimated(estimator: Estimator, events: Events) -> Callable[[], NDArray[Any]]:
    initial = estimator.initial_state(SENSOR)  # with the look-up table of the stream; no window is open

    def run() -> NDArray[Any]:
        return estimator.push(events, initial, DURATION_US).estimates[0].twists

    return run


def _in_steps(counts: Callable[[], NDArray[np.uint8]], network: NeuroVE) -> Callable[[], NDArray[Any]]:
    """Counts to network input to estimate, in plain PyTorch or with a peer's neurons, from the zero state."""
    initial, encoding = network.initial_state(1), network.config.network.encoding

    @torch.inference_mode()
    def run() -> NDArray[Any]:
        spikes = to_spikes_reference(torch.from_numpy(counts()), encoding)
        with plain():
            twists: NDArray[Any] = network(spikes[None, None], initial)[0][0, 0].numpy()
        return twists

    return run


def _numpy_counts(config: ModelConfig, events: Events) -> Callable[[], NDArray[np.uint8]]:
    lut = lookup_table(config.canonical, SENSOR, None)
    shape = (2 * config.window.bins, config.canonical.height, config.canonical.width)

    def run() -> NDArray[np.uint8]:
        counts = np.zeros(shape, np.uint8)
        count_events_reference(events, 0, config.window.bin_us, lut, counts)
        return counts

    return run


def _tonic_counts(tonic: Any, config: ModelConfig, events: Events) -> Callable[[], NDArray[np.uint8]]:
    """Frames of tonic, from events that are already on the network's grid: the scaling is not timed."""
    grid, bins = config.canonical, config.window.bins
    fields, cell = _structured(events), lookup_table(grid, SENSOR, None)[events.y, events.x]
    fields["x"], fields["y"] = cell % grid.width, cell // grid.width

    def run() -> NDArray[np.uint8]:
        frames: NDArray[Any] = tonic.to_frame_numpy(fields, (grid.width, grid.height, 2), n_time_bins=bins)
        return frames.reshape(2 * bins, grid.height, grid.width).astype(np.uint8)

    return run


def decode(rounds: int, missing: peers.Missing, *, quick: bool, with_peers: bool) -> list[Row]:
    """An EVT3 file of a Prophesee camera to events."""
    events = sweeping_edge(5_000 if quick else 1_000_000, Sensor(1280, 720))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recording.raw"
        header = b"% evt 3.0\n% format EVT3;height=720;width=1280\n% geometry 1280x720\n% end\n"
        path.write_bytes(header + _evt3(events).tobytes())

        def ours() -> list[Events]:
            return list(sources.open_source(str(path)).chunks())

        runs: dict[str, Callable[[], Any]] = {"ours": ours}
        equal: dict[str, bool | None] = {}
        faery = peers.load("faery", missing) if with_peers else None
        if faery is not None:

            def theirs() -> list[Any]:
                return list(faery.events_stream_from_file(path))

            runs["faery"] = theirs
            equal["faery"] = _same_events(theirs(), ours())
        times = interleaved(runs, rounds)
        if not equal:  # no peer is installed: compare with the written events
            times["written"], equal["written"] = times["ours"], _same_events([_structured(events)], ours())
        return rows(f"decode EVT3, {events.n:.0e} events", times, equal)


def sweeping_edge(n: int, sensor: Sensor = SENSOR) -> Events:
    """Random events of a noisy edge that sweeps over the sensor in one window; like real events, they cluster."""
    rng = np.random.default_rng(0)
    t = np.sort(rng.integers(0, DURATION_US, n))
    x = (t * sensor.width / DURATION_US + rng.normal(0, sensor.width / 12, n)).astype(np.int64) % sensor.width
    return Events.from_columns(t, x, rng.integers(0, sensor.height, n), rng.integers(0, 2, n))


def _counting_peers(events: Events, missing: peers.Missing) -> dict[str, Callable[[], Any]]:
    runs: dict[str, Callable[[], Any]] = {}
    tonic = peers.load("tonic.functional", missing)
    if tonic is not None:
        runs["tonic"] = _tonic_frames(tonic, _structured(events))
    if (dv := peers.load("dv_processing", missing)) is not None:
        runs["dv-processing"] = _dv(dv, events)
    return runs


def _tonic_frames(tonic: Any, fields: NDArray[Any]) -> Callable[[], Any]:
    shape = (2 * BINS, SENSOR.height, SENSOR.width)
    size = (SENSOR.width, SENSOR.height, 2)
    return lambda: tonic.to_frame_numpy(fields, size, n_time_bins=BINS).reshape(shape)


def _dv(dv: Any, events: Events) -> Callable[[], Any]:
    """One accumulator per channel. The store is filled before timing, because Python fills it event by event."""
    store = dv.EventStore()
    for t, x, y, p in zip(*(column.tolist() for column in events), strict=True):
        store.push_back(t, x, y, bool(p))
    accumulators = []
    for _ in range(2 * BINS):
        one = dv.Accumulator((SENSOR.width, SENSOR.height))
        one.setDecayFunction(dv.Accumulator.Decay.NONE)
        one.setEventContribution(1.0)
        one.setNeutralPotential(0.0)
        one.setMinPotential(0.0)
        one.setMaxPotential(255.0)
        one.setIgnorePolarity(True)
        accumulators.append(one)

    def run() -> NDArray[np.uint8]:
        out = np.empty((2 * BINS, SENSOR.height, SENSOR.width), np.uint8)
        for index, accumulator in enumerate(accumulators):
            first = index // 2 * DURATION_US // BINS
            accumulator.clear()
            accumulator.accept(dv.polarityFilter(store.sliceTime(first, first + DURATION_US // BINS), bool(index % 2)))
            out[index] = accumulator.generateFrame().image
        return out

    return run


def _structured(events: Events) -> NDArray[Any]:
    fields = np.empty(events.n, [("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("p", "?")])
    fields["t"], fields["x"], fields["y"], fields["p"] = events.t, events.x, events.y, events.p > 0
    return fields


def _cells(events: Events) -> NDArray[np.uint32]:
    channel = 2 * (events.t // (DURATION_US // BINS)) + events.p
    return ((channel * SENSOR.height + events.y) * SENSOR.width + events.x).astype(np.uint32)


@compiled
def _increment(where: NDArray[np.uint32], counts: NDArray[np.uint8]) -> None:  # pragma: no cover (machine code)
    for i in range(where.size):
        counts[where[i]] += np.uint8(1)


def _evt3(events: Events) -> NDArray[np.uint16]:
    """EVT3 words of single events: TIME_HIGH, TIME_LOW and ADDR_Y only when they change, ADDR_X for each event."""
    t, y = events.t, events.y.astype(np.int64)
    words = np.stack([0x8000 | t >> 12, 0x6000 | t & 0xFFF, y, 0x2000 | events.p.astype(np.int64) << 11 | events.x])
    written = np.ones(words.shape, np.bool_)
    written[0, 1:] = np.diff(t >> 12) != 0
    written[1, 1:] = np.diff(t) != 0
    written[2, 1:] = np.diff(y) != 0
    return words.T[written.T].astype("<u2")


def _same_events(theirs: list[Any], ours: list[Events]) -> bool:
    columns = [np.concatenate([getattr(events, name) for events in ours]) for name in ("t", "x", "y", "p")]
    read = np.concatenate(theirs)
    names = ("t", "x", "y", "p" if "p" in (read.dtype.names or ()) else "on")
    return all(np.array_equal(read[name], column) for name, column in zip(names, columns, strict=True))
