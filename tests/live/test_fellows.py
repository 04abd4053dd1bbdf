"""What a node hears from the other nodes of its streams."""

from neurove_protocol.duty import DutyReply
from neurove_protocol.keys import Keys
from neurove_service.node.fellows import Fellows
from tests.live.conftest import client

KEYS = Keys()


def test_a_reply_that_cannot_be_read_costs_itself(router):
    reply = DutyReply(node="good", stream="cam0", role="follows").encode()
    with client(router) as transport, client(router) as good, client(router) as bad:
        good.answer(KEYS.duty("good"), lambda _: reply)
        bad.answer(KEYS.duty("bad"), lambda _: b"\xc1")
        bad.answer(KEYS.state("bad"), lambda _: b"\x81\xa1v\x01")
        fellows = Fellows(transport, KEYS, "n1", reluctant=False)
        assert [one.node for one in fellows.roles("cam0", 60.0)] == ["good"]
        assert fellows.state("cam0", "bad", "0" * 64) is None
