"""Access control: the shipped certificates and access list refuse clients without a right (see THREATS.md)."""

import contextlib
import re

import pytest
import zenoh

from neurove_protocol import CameraInfo, Flag
from neurove_protocol.control import ActivateRequest, HealthReply, HealthRequest, PeerError
from neurove_protocol.events import encode_packet
from neurove_protocol.keys import Keys
from neurove_service.clients import ask
from neurove_service.config import ClientConfig
from tests.builders import make_packets
from tests.deploy.secured import access_list, asked, bare, deployment, free_tls, joined
from tests.live.conftest import START_S, Heard, Source, neurove, running, wait_until

pytestmark = pytest.mark.live

KEYS = Keys()
PARTICIPANTS = (
    "router-box=127.0.0.1",
    "node-edge1",
    "node-edge2",
    "driver-cam0",
    "consumer-planner",
    "recorder-desk",
    "operator-alice",
)
NOT_OPERATORS = ("node-edge2", "driver-cam0", "consumer-planner", "recorder-desk")
DIGEST = "0" * 64


class Place:
    """A router, a node behind it, and the configurations of all who may join."""

    def __init__(self, endpoint, folder, router):
        self.endpoint, self.folder, self.router = endpoint, folder, router

    def config(self, name):
        return ClientConfig(connect=(self.endpoint,), zenoh_config=self.folder / f"{name}.json5")

    def join(self, name):
        return joined(self.endpoint, self.folder / f"{name}.json5")

    def bare(self, name):
        return bare(self.endpoint, self.folder / f"{name}.json5")

    def flags(self, name):
        return ("--connect", self.endpoint, "--zenoh-config", str(self.folder / f"{name}.json5"))

    def epoch(self):
        with self.join("operator-alice") as transport:
            return ask.health(transport, self.config("operator-alice"))[0].epoch


@contextlib.contextmanager
def serving(place, *flags):
    """The real service, as node-edge1."""
    with running("serve", "--node", "edge1", "--log-level", "warning", "--probation-s", "0.5", *flags) as process:
        with place.join("operator-alice") as operator:
            ready = KEYS.alive("edge1")
            wait_until(lambda: operator.tokens(ready, 1.0) or process.child.poll() is not None, START_S)
        yield process


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    endpoint = free_tls()
    folder = deployment(tmp_path_factory.mktemp("pki"), endpoint, *PARTICIPANTS)
    with zenoh.open(zenoh.Config.from_file(str(folder / "router-box.json5"))) as router:
        place = Place(endpoint, folder, router)
        with serving(place, "--mode", "client", *place.flags("node-edge1")):
            yield place


@pytest.fixture(scope="module")
def listening_node(tmp_path_factory):
    """The service without a router: it listens itself, and has the access list in its own session."""
    endpoint = free_tls()
    names = ("node-edge1=127.0.0.1", *[name for name in PARTICIPANTS if not name.startswith(("router", "node-edge1"))])
    folder = deployment(tmp_path_factory.mktemp("peers"), endpoint, *names)
    place = Place(endpoint, folder, None)
    with serving(place, "--mode", "peer", "--listen", endpoint, "--zenoh-config", str(folder / "node-edge1.json5")):
        yield place


@pytest.fixture(params=["place", "listening_node"])
def anywhere(request):
    return request.getfixturevalue(request.param)


@pytest.fixture(scope="module")
def foreign(tmp_path_factory):
    """The same names, signed by another authority."""
    return deployment(tmp_path_factory.mktemp("foreign"), free_tls(), "operator-alice", "router-box=127.0.0.1")


def settled(session):
    """All that this session sent before has been judged: an answer to a question that everybody may ask came back."""
    wait_until(lambda: asked(session, KEYS.health("edge1"), HealthRequest().encode()))


class TestWhoMay:
    def test_the_operator_changes_the_model_and_goes_back(self, anywhere):
        config = anywhere.config("operator-alice")
        with anywhere.join("operator-alice") as operator:
            for model in ("untrained", "default"):
                reply = ask.activate(operator, config, model, "edge1")
                assert (reply.node, reply.active.name) == ("edge1", model)

    def test_the_operator_receives_the_reason_of_a_refusal(self, anywhere):
        with anywhere.join("operator-alice") as operator, pytest.raises(PeerError, match="not on this node"):
            ask.activate(operator, anywhere.config("operator-alice"), "nowhere", "edge1")

    def test_a_driver_publishes_its_stream_and_a_consumer_receives_estimates(self, anywhere):
        config = anywhere.config("consumer-planner")
        lens = CameraInfo(stream="cam0", width=64, height=48, lens="pinhole", fx=40, fy=40, cx=32, cy=24)
        with anywhere.join("driver-cam0") as driver, anywhere.join("consumer-planner") as consumer:
            heard = Heard(consumer, config)
            driver.answer(KEYS.camera("cam0"), lambda _: lens.encode())
            source = Source(driver, config, "cam0")
            for packet in make_packets(100, stream="cam0"):
                source.put(encode_packet(packet))
            wait_until(lambda: len(heard.of("cam0")) >= 3 and "cam0" in heard.statuses)
            assert Flag.UNCALIBRATED not in heard.of("cam0")[-1].flags  # the driver's answer reached the node
            assert KEYS.serves("edge1", "cam0") in consumer.tokens(KEYS.serves(), 1.0)

    @pytest.mark.parametrize("name", ["consumer-planner", "recorder-desk", "operator-alice"])
    def test_readers_may_query_health_and_models(self, anywhere, name):
        with anywhere.join(name) as transport:
            assert [reply.node for reply in ask.health(transport, anywhere.config(name))] == ["edge1"]
            assert [reply.node for reply in ask.models(transport, anywhere.config(name))] == ["edge1"]

    def test_a_recorder_receives_the_samples_of_an_inertial_unit(self, place):
        heard = []
        with place.join("driver-cam0") as driver, place.join("recorder-desk") as recorder:
            recorder.subscribe(KEYS.imu(), lambda key, payload, _: heard.append((key, payload)))
            publisher = driver.publisher(KEYS.imu("cam0"), "application/msgpack")
            wait_until(lambda: publisher.put(b"x") or heard)
            assert set(heard) == {(KEYS.imu("cam0"), b"x")}

    def test_a_recorder_receives_events_and_queries_cameras(self, place):
        heard = []
        with place.join("driver-cam0") as driver, place.join("recorder-desk") as recorder:
            driver.answer(KEYS.camera("cam0"), lambda _: b"lens")
            recorder.subscribe(KEYS.events(), lambda key, payload, _: heard.append((key, payload)))
            wait_until(lambda: [one.payload for one in recorder.ask(KEYS.camera(), b"", 1.0)] == [b"lens"])
            publisher = driver.publisher(KEYS.events("cam0"), "application/msgpack")
            wait_until(lambda: publisher.put(b"x") or heard)
            assert set(heard) == {(KEYS.events("cam0"), b"x")}

    def test_the_operator_sends_the_chunks_of_a_model_to_a_node(self, place):
        with place.join("operator-alice") as operator, place.bare("node-edge1") as node:
            operator.answer(f"{KEYS.prefix}/@push/{DIGEST}", lambda request: b"chunk " + request)
            wait_until(lambda: asked(node, f"{KEYS.prefix}/@push/{DIGEST}", b"7") == [b"chunk 7"])


class TestWhoMayNot:
    @pytest.mark.parametrize("name", NOT_OPERATORS)
    def test_only_the_operator_reaches_the_models(self, anywhere, name):
        before = anywhere.epoch()
        request = ActivateRequest(model="untrained").encode()
        with anywhere.bare(name) as intruder:
            for key in (KEYS.activate("edge1"), KEYS.activate("*"), f"{KEYS.prefix}/@node/edge1/**", "**"):
                assert asked(intruder, key, request, timeout_s=1.0) == []
        assert anywhere.epoch() == before

    def test_the_command_names_missing_permission_as_a_possible_reason(self, place):
        result = neurove("activate", "untrained", *place.flags("consumer-planner"), "--wait", "0")
        assert (result.returncode, result.stdout) == (1, "")
        assert "does its access list admit you?" in result.stderr
        assert result.stderr.count("\n") == 1

    @pytest.mark.parametrize("name", [*NOT_OPERATORS, "operator-alice"])
    def test_no_client_publishes_on_a_key_of_another_with_or_without_wildcards(self, place, name):
        through = []
        listeners = [
            place.router.declare_subscriber(key, lambda sample: through.append(str(sample.key_expr)))
            for key in ("**", f"{KEYS.prefix}/@node/**", f"{KEYS.prefix}/@push/**")
        ]
        own = {"driver-cam0": KEYS.events("cam0"), "node-edge2": KEYS.velocity("cam9")}.get(name)
        with place.bare(name) as intruder:
            for key in (
                KEYS.activate("edge1"),
                f"{KEYS.prefix}/@node/*/model/*",
                f"{KEYS.prefix}/@node/**",
                KEYS.health("edge1"),
                f"{KEYS.prefix}/@push/{DIGEST}",
                KEYS.events("cam1"),
                KEYS.events("*"),
                KEYS.camera("*"),
                KEYS.imu("cam1"),
                f"{KEYS.prefix}/**",
                "**",
                *([] if name == "node-edge2" else [KEYS.velocity("cam0"), KEYS.velocity("*"), KEYS.status("cam0")]),
            ):
                intruder.put(key, b"forged")
                intruder.delete(key)
            if own is None:
                settled(intruder)
            else:
                intruder.put(own, b"own")
                wait_until(lambda: own in through)
        seen = ["t/seen", f"{KEYS.prefix}/@node/seen", f"{KEYS.prefix}/@push/seen"]
        for key in seen:
            place.router.put(key, b"")
        wait_until(lambda: set(seen) <= set(through))  # so each listener has seen all that came before
        for listener in listeners:
            listener.undeclare()
        assert [key for key in through if key not in (own, *seen, *told_by_the_node())] == []

    @pytest.mark.parametrize("name", [*NOT_OPERATORS, "operator-alice"])
    def test_a_spoofed_queryable_is_not_reached(self, anywhere, name):
        reached = []

        def lie(query):
            reached.append(str(query.key_expr))
            with query:
                query.reply(str(query.key_expr), b"lie")

        spoofed = [
            KEYS.activate("edge1"),
            KEYS.health("edge1"),
            KEYS.models("edge1"),
            f"{KEYS.prefix}/@node/**",
            "**",
            *([] if name == "operator-alice" else [f"{KEYS.prefix}/@push/**"]),
        ]
        with anywhere.bare(name) as intruder, anywhere.bare("operator-alice") as operator:
            for key in spoofed:
                intruder.declare_queryable(key, lie)
            if name not in ("node-edge2", "driver-cam0"):  # these may ask nothing
                settled(intruder)
                reached.clear()  # its own question
            for node in ("edge1", "*") * 3:
                (answer,) = asked(operator, KEYS.health(node), HealthRequest().encode())
                assert HealthReply.decode(answer).node == "edge1"
                answers = asked(operator, KEYS.activate(node), ActivateRequest(model="nowhere").encode())
                assert len([one for one in answers if b"not on this node" in one]) == len(answers) > 0  # steps, refusal
            assert asked(operator, f"{KEYS.prefix}/@push/{DIGEST}", timeout_s=1.0) == []
        assert reached == []

    def test_a_driver_cannot_answer_for_the_camera_of_another(self, place):
        with place.join("driver-cam0") as driver, place.join("recorder-desk") as recorder:
            driver.answer(KEYS.camera("cam0"), lambda _: b"own")
            driver.answer(KEYS.camera("cam1"), lambda _: b"forged")
            wait_until(lambda: recorder.ask(KEYS.camera(), b"", 1.0))
            assert [one.payload for one in recorder.ask(KEYS.camera(), b"", 1.0)] == [b"own"]
            assert recorder.ask(KEYS.camera("cam1"), b"", 1.0) == []

    @pytest.mark.parametrize("name", NOT_OPERATORS)
    def test_no_client_declares_the_liveliness_token_of_another(self, anywhere, name):
        with anywhere.join(name) as intruder, anywhere.join("operator-alice") as operator:
            intruder.token(KEYS.alive("edge9"))
            intruder.token(KEYS.serves("edge1", "cam9"))
            if name == "node-edge2" and anywhere.router is not None:
                intruder.token(KEYS.alive("edge2"))
                wait_until(lambda: KEYS.alive("edge2") in operator.tokens(KEYS.alive(), 1.0))
            assert KEYS.alive("edge9") not in operator.tokens(KEYS.alive(), 1.0)
            assert KEYS.serves("edge1", "cam9") not in operator.tokens(KEYS.serves(), 1.0)

    @pytest.mark.parametrize("name", ["driver-cam0", "consumer-planner", "operator-alice"])
    @pytest.mark.parametrize("what", [KEYS.events, KEYS.imu])
    def test_only_the_node_and_a_recorder_receive_what_a_driver_publishes(self, place, name, what):
        heard, recorded = [], []
        with place.bare(name) as curious, place.join("recorder-desk") as recorder, place.join("driver-cam0") as driver:
            for key in (what(), f"{KEYS.prefix}/**", "**"):
                curious.declare_subscriber(key, lambda sample: heard.append(str(sample.key_expr)))
            recorder.subscribe(what(), lambda key, *_: recorded.append(key))
            publisher = driver.publisher(what("cam0"), "application/msgpack")
            wait_until(lambda: publisher.put(b"x") or len(recorded) >= 5)
        assert not [key for key in heard if key.endswith(("/events", "/imu"))]


def told_by_the_node():
    """What the real service may say while a test runs."""
    return (KEYS.status("cam0"), KEYS.velocity("cam0"))


class TestWhoDoesNotGetIn:
    def test_refuses_a_client_without_a_certificate(self, anywhere):
        with pytest.raises(zenoh.ZError, match="Unable to connect"):
            bare(anywhere.endpoint)

    def test_refuses_a_client_without_its_own_certificate(self, anywhere):
        """Knows the authority, as everybody may, but has nothing to show."""
        certificate = (anywhere.folder / "ca.crt").as_posix()
        with pytest.raises(zenoh.ZError, match="Unable to connect"):
            bare(anywhere.endpoint, **{"transport/link/tls/root_ca_certificate": certificate})

    def test_refuses_a_certificate_of_another_authority(self, anywhere, foreign, tmp_path):
        own = (foreign / "operator-alice.json5").read_text()
        trusting = re.sub(r"root_ca_certificate_base64: .*", trusted(anywhere.folder / "operator-alice.json5"), own)
        (tmp_path / "trusting.json5").write_text(trusting)
        for config in (foreign / "operator-alice.json5", tmp_path / "trusting.json5"):
            with pytest.raises(zenoh.ZError, match="Unable to connect"):
                bare(anywhere.endpoint, config)

    def test_refuses_a_client_without_encryption(self, anywhere):
        with pytest.raises(zenoh.ZError, match="Unable to connect"):
            bare(anywhere.endpoint.replace("tls/", "tcp/"))

    def test_the_command_names_certificates_as_a_possible_reason(self, place, foreign):
        config = str(foreign / "operator-alice.json5")
        result = neurove("health", "--connect", place.endpoint, "--zenoh-config", config, "--wait", "0")
        assert result.returncode == 1
        assert "or one side refuses the other's certificate (zenoh_config)" in result.stderr
        assert result.stderr.count("\n") == 1

    def test_a_stolen_client_certificate_does_not_make_a_router(self, place, tmp_path):
        """Nobody speaks to a listener whose certificate was not made for listening."""
        endpoint = free_tls()
        router = (place.folder / "router-box.json5").read_text().replace(place.endpoint, endpoint)
        driver = (place.folder / "driver-cam0.json5").read_text()
        for what in ("certificate", "private_key"):
            stolen = re.search(rf"connect_{what}_base64: (.*)", driver)[1]
            router = re.sub(rf"listen_{what}_base64: .*", f"listen_{what}_base64: {stolen}", router)
        (tmp_path / "rogue.json5").write_text(router)
        with (
            zenoh.open(zenoh.Config.from_file(str(tmp_path / "rogue.json5"))),
            pytest.raises(zenoh.ZError, match="Unable to connect"),
        ):
            bare(endpoint, place.folder / "operator-alice.json5")


def trusted(config):
    return re.search(r"root_ca_certificate_base64: .*", config.read_text())[0]


def test_a_certificate_that_is_removed_from_the_list_has_no_rights(tmp_path):
    endpoint = free_tls()
    names = ("router-box=127.0.0.1", "operator-alice", "operator-bob")
    folder = deployment(tmp_path / "pki", endpoint, *names)
    bobs = (folder / "operator-bob.json5").rename(tmp_path / "bob.json5")
    (folder / "operator-bob.crt").unlink()
    deployment(folder, endpoint)
    assert "operator-bob" not in str(access_list(folder / "router-box.json5"))
    with zenoh.open(zenoh.Config.from_file(str(folder / "router-box.json5"))) as router:
        router.declare_queryable(KEYS.health("edge1"), lambda query: answer(query, b"fine"))
        with bare(endpoint, folder / "operator-alice.json5") as alice, bare(endpoint, bobs) as bob:
            wait_until(lambda: asked(alice, KEYS.health("edge1")) == [b"fine"])
            assert asked(bob, KEYS.health("edge1"), timeout_s=1.0) == []


def answer(query, payload):
    with query:
        query.reply(str(query.key_expr), payload)
