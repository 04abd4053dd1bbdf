"""The health of nodes as metrics of Prometheus, made at each scrape from the counters that every reply has.

Labels are bounded: names of nodes and streams are those of the protocol, texts are truncated, and what exceeds a cap is
left out and counted. Two nodes of one name, or a stream that a reply lists twice, count once.
"""

from collections.abc import Iterable, Iterator, Sequence
from itertools import accumulate
from typing import Final, NamedTuple, get_args

from prometheus_client import generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric

from neurove_protocol import Flag
from neurove_protocol.control import LATENCY_BOUNDS_MS, HealthReply, StreamStatus, Verdict

CONTENT_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"

MAX_NODES: Final = 1024
MAX_STREAMS: Final = 4096
"""Streams of all nodes together."""

MAX_PLACES: Final = 32
"""Places of a node that had internal errors."""

MAX_LABEL: Final = 64
"""Characters of a label's value."""

_NODE: Final = ("node",)
_STREAM: Final = ("node", "stream")
_STREAM_COUNTERS: Final = {
    "packets_received": "Event packets that arrived.",
    "events_received": "Events that arrived.",
    "windows": "Windows that were completed.",
    "estimates": "Estimates that were published.",
    "resets": "Resets of the recurrent state.",
    "outside_events": "Events outside the field of view of the network: cropped, not lost.",
    "recovered_packets": "Packets that arrived after the packets that follow them.",
    "uncounted_packets": "Packets with the sequence number 0 only, so that losses cannot be counted.",
    "refused_cameras": "CameraInfo messages that were refused or do not belong to the sensor.",
    "unrefined_windows": "Windows that were answered by the network alone, because the stream was behind.",
}
_LOSSES: Final = {
    "packets": "Event packets that are not part of an estimate, by cause.",
    "windows": "Windows without an estimate, by cause.",
    "events": "Events that are not part of an estimate, by cause, in addition to those of lost packets.",
}
_IMU_LOSSES: Final = ("lost", "refused", "dropped")


class Fleet(NamedTuple):
    """What an exporter knows about its nodes at one moment."""

    replies: Sequence[HealthReply]
    silent: Sequence[str] = ()  # nodes that are alive and do not answer
    refused: int = 0  # replies that break a rule of the protocol


class _Text:
    """A source of metrics for prometheus-client."""

    def __init__(self, metrics: Iterable[Metric]) -> None:
        self._metrics = metrics

    def collect(self) -> Iterable[Metric]:
        return self._metrics


def exposition(fleet: Fleet) -> bytes:
    """The metrics as Prometheus text, format 0.0.4."""
    return bytes(generate_latest(_Text(families(fleet))))


def families(fleet: Fleet) -> Iterator[Metric]:
    """Every metric of the nodes and of their streams."""
    by_node = {reply.node: reply for reply in reversed(fleet.replies)}
    nodes = sorted(by_node.values(), key=lambda reply: reply.node)[:MAX_NODES]
    silent = sorted(set(fleet.silent) - by_node.keys())[:MAX_NODES]
    every = [(reply.node, status) for reply in nodes for status in _unique(reply.streams)]
    streams = every[:MAX_STREAMS]
    left_out = {
        "nodes": max(0, len(by_node) - MAX_NODES),
        "streams": len(every) - len(streams),
        "refused_replies": fleet.refused,
    }
    yield from _of_nodes(nodes, silent)
    yield from _of_streams(streams)
    yield from _of_imus(streams)
    yield _gauge("neurove_exporter_left_out", "What the exporter does not show.", ("what",), left_out.items())


def _unique(streams: Iterable[StreamStatus]) -> list[StreamStatus]:
    return list({status.stream: status for status in streams}.values())


def _clipped(text: str) -> str:
    return text if len(text) <= MAX_LABEL else text[: MAX_LABEL - 3] + "..."


def _gauge(
    name: str, about: str, labels: tuple[str, ...], values: Iterable[tuple[str | tuple[str, ...], float]]
) -> Metric:
    family = GaugeMetricFamily(name, about, labels=labels)
    for label, value in values:
        family.add_metric((label,) if isinstance(label, str) else label, value)
    return family


def _counter(
    name: str, about: str, labels: tuple[str, ...], values: Iterable[tuple[str | tuple[str, ...], float]]
) -> Metric:
    family = CounterMetricFamily(name, about, labels=labels)
    for label, value in values:
        family.add_metric((label,) if isinstance(label, str) else label, value)
    return family


def _of_nodes(nodes: Sequence[HealthReply], silent: Sequence[str]) -> Iterator[Metric]:
    up = [*((reply.node, 1.0) for reply in nodes), *((name, 0.0) for name in silent)]
    yield _gauge("neurove_node_up", "1 if the node answers with its health.", _NODE, up)
    yield _gauge("neurove_node_ok", "1 if the node is healthy.", _NODE, ((one.node, one.ok) for one in nodes))
    ready = [*((one.node, float(one.ready)) for one in nodes), *((name, 0.0) for name in silent)]
    yield _gauge("neurove_node_ready", "1 if the node answers the next packet of a stream.", _NODE, ready)
    for name, about, value in (
        ("uptime_seconds", "Time since the node started.", lambda one: one.uptime_s),
        ("streams", "Streams that the node serves.", lambda one: len(one.streams)),
        (
            "refused_streams",
            "Streams that are refused now, because max_streams is reached.",
            lambda one: one.refused_streams,
        ),
        ("missing_streams", "Expected streams without packets now.", lambda one: len(one.missing_streams)),
        ("namesakes", "Other nodes of this name on the network.", lambda one: one.namesakes),
    ):
        yield _gauge(f"neurove_node_{name}", about, _NODE, [(one.node, value(one)) for one in nodes])
    for name, about, value in (
        ("model_changes", "Changes of the active model.", lambda one: one.epoch),
        ("model_rollbacks", "Automatic rollbacks of a model.", lambda one: one.rollbacks),
        ("dropped_log_lines", "Log lines that were not read in time.", lambda one: one.dropped_log_lines),
    ):
        yield _counter(f"neurove_{name}", about, _NODE, [(one.node, value(one)) for one in nodes])
    errors = [((one.node, place), number) for one in nodes for place, number in _places(one.internal_errors).items()]
    yield _counter("neurove_internal_errors", "Internal errors, by place in the node.", ("node", "place"), errors)
    yield _gauge(
        "neurove_build_info",
        "Version of the package.",
        ("node", "version"),
        [((one.node, _clipped(one.version)), 1.0) for one in nodes],
    )
    yield _gauge(
        "neurove_node_label",
        "A label of the configuration of the node.",
        ("node", "label", "value"),
        [
            ((one.node, _clipped(label), _clipped(value)), 1.0)
            for one in nodes
            for label, value in sorted(one.labels.items())
        ],
    )
    yield _gauge(
        "neurove_model_info",
        "The active model.",
        ("node", "model", "digest", "trained", "signature"),
        [
            ((one.node, _clipped(model.name), _clipped(model.digest), str(model.trained).lower(), model.signature), 1.0)
            for one in nodes
            for model in (one.model,)
        ],
    )


def _places(errors: dict[str, int]) -> dict[str, int]:
    """The places with the most errors; those with one label count together."""
    found: dict[str, int] = {}
    for place, number in sorted(errors.items(), key=lambda item: -item[1])[:MAX_PLACES]:
        found[_clipped(place)] = found.get(_clipped(place), 0) + number
    return found


def _of_streams(streams: Sequence[tuple[str, StreamStatus]]) -> Iterator[Metric]:
    keyed = [((node, status.stream), status) for node, status in streams]
    standing = [(key, one.standby) for key, one in keyed if one.standby is not None]
    answers = [(key, float(one.role == "answers")) for key, one in standing]
    yield _gauge(
        "neurove_stream_answers", "1 if the node answers a stream that others can answer too.", _STREAM, answers
    )
    ready = [(key, float(one.role == "follows" and one.equal)) for key, one in standing]
    yield _gauge(
        "neurove_stream_follows", "1 if the node follows such a stream and is ready to answer.", _STREAM, ready
    )
    for name, about in _STREAM_COUNTERS.items():
        yield _counter(f"neurove_{name}", about, _STREAM, [(key, getattr(one, name)) for key, one in keyed])
    for what, about in _LOSSES.items():
        lost = [
            ((*key, name.removesuffix(f"_{what}")), number)
            for key, one in keyed
            for name, number in one.lost.model_dump().items()
            if name.endswith(what)
        ]
        yield _counter(f"neurove_lost_{what}", about, (*_STREAM, "cause"), lost)
    verdicts = [((*key, verdict), float(one.verdict == verdict)) for key, one in keyed for verdict in get_args(Verdict)]
    yield _gauge("neurove_stream_verdict", "1 for the verdict of the stream.", (*_STREAM, "verdict"), verdicts)
    calibrated = [(key, float(one.calibrated)) for key, one in keyed]
    yield _gauge("neurove_stream_calibrated", "1 if a CameraInfo is in use.", _STREAM, calibrated)
    ages = [(key, one.last_packet_age_s) for key, one in keyed]
    yield _gauge("neurove_last_packet_age_seconds", "Time since the newest packet arrived.", _STREAM, ages)
    flags = [
        ((*key, flag.value), one.flag_counts.get(flag.value, 0))
        for key, one in keyed
        for flag in Flag
        if one.latency_histogram is not None  # a node that counts them
    ]
    yield _counter("neurove_flagged_estimates", "Estimates by flag.", (*_STREAM, "flag"), flags)
    yield from _sigma(keyed)
    yield _latency(keyed)


def _sigma(keyed: Sequence[tuple[tuple[str, str], StreamStatus]]) -> Iterator[Metric]:
    for name, about, first in (
        ("linear_sigma_meters_per_second", "Standard deviation of the newest linear velocity, by axis.", 0),
        ("angular_sigma_radians_per_second", "Standard deviation of the newest angular velocity, by axis.", 3),
    ):
        values = [
            ((*key, axis), one.sigma[first + place])
            for key, one in keyed
            if one.sigma is not None
            for place, axis in enumerate("xyz")
        ]
        yield _gauge(f"neurove_{name}", about, (*_STREAM, "axis"), values)


def _latency(keyed: Sequence[tuple[tuple[str, str], StreamStatus]]) -> Metric:
    about = "From receiving the last packet of a window to publishing its estimate."
    family = HistogramMetricFamily("neurove_latency_seconds", about, labels=_STREAM)
    names = [*(str(bound / 1e3) for bound in LATENCY_BOUNDS_MS), "+Inf"]
    for key, one in keyed:
        histogram = one.latency_histogram
        if histogram is not None:
            buckets = [(name, float(total)) for name, total in zip(names, accumulate(histogram.counts), strict=True)]
            family.add_metric(key, buckets, histogram.sum_ms / 1e3)
    return family


def _of_imus(streams: Sequence[tuple[str, StreamStatus]]) -> Iterator[Metric]:
    units = [((node, status.stream), status.imu) for node, status in streams if status.imu is not None]
    yield _counter(
        "neurove_imu_samples", "Samples of the inertial unit.", _STREAM, [(key, u.samples) for key, u in units]
    )
    lost = [((*key, cause), getattr(unit, f"{cause}_packets")) for key, unit in units for cause in _IMU_LOSSES]
    yield _counter("neurove_imu_lost_packets", "IMU packets that are not used, by cause.", (*_STREAM, "cause"), lost)
    used = [(key, float(unit.used)) for key, unit in units]
    yield _gauge("neurove_imu_used", "1 if the gyroscope gives the angular velocity.", _STREAM, used)
    problems = [(key, float(bool(unit.problem))) for key, unit in units]
    yield _gauge("neurove_imu_problem", "1 if something is wrong with the inertial unit.", _STREAM, problems)
