"""Event images: what a PNG shows, and that a browser gets each image once."""

import asyncio
import io
import struct

import numpy as np
import pytest
from PIL import Image

from neurove_protocol.events import EventPacket, Events, Sensor, encode_packet
from neurove_service.guard import Guard
from neurove_service.page.images import HEAD, MAX_WATCHED, Images, png_of

COLOURS = ((0x10, 0x15, 0x1C), (0xE6, 0x8A, 0x2E), (0x56, 0xB4, 0xE9))


class Link:
    """A transport whose streams have the packets that a test puts there."""

    def __init__(self):
        self.waiting = {}

    def subscribe_newest(self, key, most):
        packets = self.waiting.setdefault(key, [])

        def take():
            taken, packets[:] = packets[-most:], []
            return taken

        return take, lambda: self.waiting.pop(key)


def pixels(png):
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))


def packet(x, y, p, seq=0, t_us=0):
    """A packet with one event."""
    return encode_packet(EventPacket("cam0", seq, Sensor(31, 7), t_us, Events.from_columns([t_us], [x], [y], [p])))


def outside(payload):
    """A packet of one event whose x is 40, which is not on the sensor."""
    return payload[:-4] + struct.pack("<H", 40) + payload[-2:]


def parts(data):
    """The images in what a browser receives: place of the stream -> PNG."""
    found = {}
    while data:
        _, place, size = HEAD.unpack_from(data)
        found[place] = data[HEAD.size : HEAD.size + size]
        data = data[HEAD.size + size :]
    return found


@pytest.mark.parametrize("shape", [(1, 1), (3, 4), (5, 7), (260, 346)])
def test_a_png_shows_every_pixel(shape):
    canvas = np.random.default_rng(20011).integers(0, 3, shape, dtype=np.uint8)
    np.testing.assert_array_equal(pixels(png_of(canvas)), np.array(COLOURS, np.uint8)[canvas])


def test_an_image_has_the_newest_events_and_is_sent_once():
    async def look():
        link, images = Link(), Images(str, Guard())
        follow = images.follow(["cam1", "cam0"], link)
        coming = asyncio.create_task(anext(follow))
        while "cam0" not in link.waiting:  # subscribed for the first round
            await asyncio.sleep(0)
        link.waiting["cam0"] += [
            packet(3, 2, 0),
            b"garbled",
            packet(30, 6, 1, 1, 10_000),
            outside(packet(9, 6, 1, 2, 10_000)),
        ]
        ((place, png),) = parts(await coming).items()
        both = pixels(png)
        assert (place, both.shape) == (1, (7, 31, 3))
        assert (tuple(both[2, 3]), tuple(both[6, 30])) == COLOURS[1:]
        assert (both != COLOURS[0]).any(axis=2).sum() == 2  # the event outside the sensor is nowhere
        late = images.follow(["cam0"], link)
        assert parts(await anext(late)) == {0: png}  # a browser that has none gets the newest one
        assert parts(await anext(follow)) == {0: b""}  # nothing new: a sign of life after some time
        link.waiting["cam0"].append(packet(1, 1, 1, 3, 30_000))
        first, second = await asyncio.gather(anext(follow), anext(late))
        assert parts(first)[1] == parts(second)[0]
        newer = pixels(parts(first)[1])
        assert tuple(newer[6, 30]) == COLOURS[2]  # 20 ms before the newest event
        assert tuple(newer[2, 3]) == COLOURS[0]  # 30 ms before it

    asyncio.run(look())


class Camera(Link):
    """A transport on which a packet of each stream with a subscriber has waited since it was subscribed, or never."""

    def __init__(self, packets):
        super().__init__()
        self.packets, self.begun = packets, 0

    def subscribe_newest(self, key, most):
        self.begun += 1
        subscription = super().subscribe_newest(key, most)
        self.waiting[key] += [packet(self.begun % 31, 0, 1, seq, 10_000 * seq) for seq in range(self.packets)]
        return subscription


STREAMS = [f"cam{number}" for number in range(4)]


async def _rounds(link, number):
    """Look at four streams for some rounds; the streams that are received between two of them."""
    images = Images(str, Guard())
    follow = images.follow(STREAMS, link)
    between = []
    for _ in range(number):
        assert set(parts(await anext(follow))) <= {0, 1, 2, 3}
        between.append(set(link.waiting))
        for packets in link.waiting.values():  # of the streams that are still received
            packets.append(packet(5, 5, 0, 100, 10_000_000 * (1 + len(between))))
    return between


def test_between_two_rounds_nothing_is_received_of_a_stream_whose_packets_suffice():
    link = Camera(packets=6)
    between = asyncio.run(_rounds(link, 3))
    assert between == [set()] * 3
    assert link.begun == 3 * len(STREAMS)


def test_a_stream_whose_packets_come_too_seldom_is_received_always():
    link = Camera(packets=1)
    between = asyncio.run(_rounds(link, 5))
    assert between == [set(STREAMS)] * 5
    assert link.begun == len(STREAMS)


def test_streams_with_images_are_bounded():
    async def look():
        link, images = Link(), Images(str, Guard())
        follow = images.follow([f"cam{number}" for number in range(MAX_WATCHED + 5)], link)
        assert parts(await anext(follow)) == {0: b""}
        return len(images.watched), len(link.waiting)

    assert asyncio.run(look()) == (MAX_WATCHED, MAX_WATCHED)
