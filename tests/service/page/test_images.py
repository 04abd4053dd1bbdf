"""Event images: what a PNG shows, and that a browser gets each image once."""

import asyncio
import io

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


def parts(answer, number):
    """Number and PNG of each image of an answer."""
    found = []
    for _ in range(number):
        head, size = HEAD.unpack_from(answer)
        found.append((head, answer[HEAD.size : HEAD.size + size]))
        answer = answer[HEAD.size + size :]
    assert answer == b""
    return found


@pytest.mark.parametrize("shape", [(1, 1), (3, 4), (5, 7), (260, 346)])
def test_a_png_shows_every_pixel(shape):
    canvas = np.random.default_rng(20011).integers(0, 3, shape, dtype=np.uint8)
    np.testing.assert_array_equal(pixels(png_of(canvas)), np.array(COLOURS, np.uint8)[canvas])


def test_an_image_has_the_newest_events_and_is_sent_once():
    async def follow():
        link, images = Link(), Images(str, Guard())
        assert parts(await images.newer({"cam0": 0}, link), 1) == [(0, b"")]  # no packet yet
        link.waiting["cam0"] += [packet(3, 2, 0), b"garbled", packet(30, 6, 1, 1, 10_000)]
        ((number, png),) = parts(await images.newer({"cam0": 0}, link), 1)
        both = pixels(png)
        assert both.shape == (7, 31, 3)
        assert (tuple(both[2, 3]), tuple(both[6, 30])) == COLOURS[1:]
        assert parts(await images.newer({"cam0": number, "cam1": 0}, link), 2) == [(number, b""), (0, b"")]
        ((_, again),) = parts(await images.newer({"cam0": 0}, link), 1)
        assert again == png  # for a browser that has none
        link.waiting["cam0"].append(packet(1, 1, 1, 2, 30_000))
        ((newer, png),) = parts(await images.newer({"cam0": number}, link), 1)
        assert newer > number
        assert tuple(pixels(png)[6, 30]) == COLOURS[2]  # 20 ms before the newest event
        assert tuple(pixels(png)[2, 3]) == COLOURS[0]  # 30 ms before it

    asyncio.run(follow())


def test_streams_with_images_are_bounded():
    async def ask():
        link, images = Link(), Images(str, Guard())
        names = {f"cam{number}": 0 for number in range(MAX_WATCHED + 5)}
        await images.newer(names, link)
        return len(images.watched), len(link.waiting)

    assert asyncio.run(ask()) == (MAX_WATCHED, MAX_WATCHED)
