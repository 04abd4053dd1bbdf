"""Names on the network of rmw_zenoh: recorded ones are understood, and ours have the same form."""

import json

import pytest

from neurove_core.io.formats.ros import types
from neurove_protocol.errors import InvalidField
from neurove_service.ros2 import graph
from neurove_service.ros2.graph import Attachment, Entity, Node, Qos, Topic
from tests.recordings import shared

SESSION = "2006eb73d282c4b812b873f0fa6afff3"
VELOCITY = Topic("/rover/front/cam0/velocity", types.TWIST)
# of a node of rmw_zenoh_cpp 0.6.7, as recorded
NODE_TOKEN = f"@ros2_lv/0/{SESSION}/0/0/NN/%/%rover%front/golden"
VELOCITY_TOKEN = (
    f"@ros2_lv/0/{SESSION}/0/11/MP/%/%rover%front/golden/%rover%front%cam0%velocity/"
    "geometry_msgs::msg::dds_::TwistWithCovarianceStamped_/"
    "RIHS01_77b67434531e6529b7a0091357b186b6ebdb17fd9ffd3e0c7ce9d3fb11a44563/::,10:,:,:,,"
)
VELOCITY_KEY = (
    "0/rover/front/cam0/velocity/geometry_msgs::msg::dds_::TwistWithCovarianceStamped_/"
    "RIHS01_77b67434531e6529b7a0091357b186b6ebdb17fd9ffd3e0c7ce9d3fb11a44563"
)
ATTACHMENT = bytes.fromhex("0100000000000000affa2134c963ec18107c408e4a4a236aa4b7106808947e560e")


def test_our_tokens_keys_and_attachments_are_those_recorded():
    node = Node(0, SESSION, "/rover/front", "golden", "kilted")
    assert node.token == NODE_TOKEN
    tokens = [node.entity("MP", VELOCITY, Qos(depth=10)) for _ in range(11)]
    assert tokens[-1] == VELOCITY_TOKEN
    assert graph.key(0, VELOCITY, "kilted") == VELOCITY_KEY
    assert Attachment(1, 1795920067228203695, graph.gid_of(VELOCITY_TOKEN)).encode() == ATTACHMENT


def test_humble_has_no_type_hash_and_the_others_have_the_same():
    keys = {distro: graph.key(5, VELOCITY, distro) for distro in graph.DISTROS}
    assert keys["humble"].endswith("/TypeHashNotSupported")
    assert keys["humble"].startswith("5/rover/front/cam0/velocity/")
    assert len({keys[distro] for distro in ("jazzy", "kilted", "lyrical")}) == 1
    assert Node(5, SESSION, "/", "n", "humble").entity("MS", VELOCITY, Qos()).split("/")[-2] == graph.NO_HASH


def test_a_node_without_namespace_has_a_percent_sign():
    assert Node(0, SESSION, "/", "n", "kilted").token == f"@ros2_lv/0/{SESSION}/0/0/NN/%/%/n"


def test_a_token_says_who_publishes_what():
    entity = Entity.of_token(VELOCITY_TOKEN)
    assert (entity.domain, entity.session, entity.kind, entity.node) == (0, SESSION, "MP", "/rover/front/golden")
    assert (entity.topic, entity.type, entity.hash) == (*VELOCITY, types.HASHES[types.TWIST])
    assert entity.qos == Qos(reliable=True, depth=10)


@pytest.mark.parametrize(
    ("chunk", "qos"),
    [
        ("::,10:,:,:,,", Qos()),
        ("2::,1000:,:,:,,", Qos(reliable=False, depth=1000)),
        (":1:,1:,:,:,,", Qos(latched=True, depth=1)),
        ("::2,1:,:,:,,", Qos(keep_all=True, depth=1)),
        ("::,:,:,:,,", Qos(depth=42)),
    ],
)
def test_recorded_qos_is_read_and_written(chunk, qos):
    assert Qos.of_chunk(chunk) == qos
    assert qos.chunk() == chunk


@pytest.mark.parametrize(
    "token", ["", "@ros2_lv/0/a/0/0/NN/%/%/n", VELOCITY_TOKEN.replace("::,10", "9::,10"), "a/" * 20]
)
def test_another_form_is_refused(token):
    with pytest.raises(InvalidField):
        Entity.of_token(token)


@pytest.mark.parametrize("data", [b"", ATTACHMENT[:-1], ATTACHMENT + b"\0", bytes(33)])
def test_an_attachment_of_another_form_is_refused(data):
    with pytest.raises(InvalidField, match="33 bytes"):
        Attachment.decode(data)


def test_the_recorded_traffic_of_a_real_node_is_understood():
    """Every token, identity, attachment and payload; the writer has the same form, padding aside."""
    recorded = json.loads(shared("ros2/rmw_zenoh_kilted.json").read_text())
    tokens = [key for _, key in recorded["tokens"] if key.startswith("@ros2_lv")]
    entities = [Entity.of_token(token) for token in tokens if "/NN/" not in token]
    assert {entity.kind for entity in entities} == {"MP", "MS", "SS"}
    assert {entity.node for entity in entities} == {"/rover/front/golden"}
    ours = [entity for entity in entities if entity.type in types.HASHES]
    assert {entity.type for entity in ours} == set(types.HASHES) - {types.POSE}
    assert all(entity.hash == types.HASHES[entity.type] for entity in ours)
    identities = {graph.gid_of(token): token for token in tokens}
    for sample in recorded["samples"]:
        attachment = Attachment.decode(bytes.fromhex(sample["attachment"]))
        entity = Entity.of_token(identities[attachment.gid])
        assert (attachment.seq in (1, 2), graph.type_of(sample["key"])) == (True, entity.type)
        if entity.type not in types.HASHES:
            continue
        assert sample["key"] == graph.key(0, Topic(entity.topic, entity.type), "kilted")
        payload = bytes.fromhex(sample["payload"])
        message = types.decode(entity.type, payload)
        assert (message.header.stamp.sec, len(types.encode(message))) == (12, len(payload))
        assert types.decode(entity.type, types.encode(message)) == message
