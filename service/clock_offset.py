"""The offset between a sender's clock and the one of this process, learned from the messages that arrive quickest."""

DRIFT = 200e-6
"""The clock of a sender may be slower than that of this process by this share: 100 ppm for each of two crystals."""


class ClockOffset:
    """The offset is that of the quickest message, because a message cannot arrive before it was sent.

    It grows by no more than the drift of two crystals, so a delay that grows is seen as age. A delay that all messages
    share is not seen.

    >>> offset = ClockOffset()
    >>> [offset.learn(sent_ns, sent_ns + 10**9 + way_ns) for sent_ns, way_ns in ((0, 7), (5, 3), (9, 4))]
    [0, 0, 1]
    """

    def __init__(self) -> None:
        self._offset_ns: int | None = None
        self._learned_ns = 0

    def forget(self) -> None:
        """Begin anew: the clock of the sender has changed."""
        self._offset_ns = None

    def learn(self, sent_ns: int, received_ns: int) -> int:
        """The delay of a message beyond the quickest one [ns].

        Args:
            sent_ns: on the clock of the sender [ns].
            received_ns: on the clock of this process [ns].
        """
        offset_ns = received_ns - sent_ns
        drifted_ns = offset_ns
        if self._offset_ns is not None:
            drifted_ns = self._offset_ns + int(DRIFT * max(0, received_ns - self._learned_ns))
        self._offset_ns, self._learned_ns = min(offset_ns, drifted_ns), received_ns
        return offset_ns - self._offset_ns
