"""neurove doctor without a service: the checks of this machine, as text and as JSON."""

import json

import pytest

from neurove_protocol import Flag, TwistEstimate
from neurove_protocol.control import HealthReply, StreamStatus
from neurove_service.cli import doctor, extras, installation
from tests.protocol.messages import EXAMPLES, STATUS

NOWHERE = "tcp/127.0.0.1:9"


def test_without_a_service_the_connection_is_bad_and_the_advice_says_what_to_do(run):
    code, out, err = run("doctor", "--connect", NOWHERE, "--json")
    report = json.loads(out)
    assert (code, err, report["ok"]) == (1, "", False)
    checks = {check["what"]: check for check in report["checks"]}
    assert checks["connection"]["level"] == "bad"
    assert "neurove serve" in checks["connection"]["advice"]
    assert checks["extra serve"] == {"what": "extra serve", "state": "installed", "level": "ok", "advice": ""}
    assert {"compiled kernels", "processor", "fast path"} <= checks.keys()
    assert "float32" in checks["fast path"]["state"]
    assert "golden windows" in checks["fast path"]["state"]


def test_the_table_has_one_row_for_each_check(run):
    code, out, _ = run("doctor", "--connect", NOWHERE)
    assert code == 1
    assert "no router and no service at" in out
    assert "pip install 'neurove[carla]'" in out


def test_a_wrong_endpoint_is_reported(run):
    _, out, _ = run("doctor", "--connect", "nonsense", "--json")
    first = json.loads(out)["checks"][0]
    assert (first["what"], first["level"], "nonsense" in first["state"]) == ("settings", "bad", True)


def test_kernels_are_counted_where_numba_caches_them(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    assert installation.check_kernels().level == "info"
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache" / "a.nbi").touch()
    found = installation.check_kernels()
    assert (found.level, found.state.startswith("1 cached")) == ("ok", True)


def test_a_cache_that_cannot_be_written_is_bad(monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/proc/no-such-folder")
    monkeypatch.setattr("os.access", lambda *_: False)  # root may write everywhere
    found = installation.check_kernels()
    assert (found.level, "NUMBA_CACHE_DIR" in found.advice) == ("bad", True)


class TestCameras:
    @pytest.fixture
    def devices(self, tmp_path):
        """A folder as Linux lists a USB device with the numbers of a camera."""
        device = tmp_path / "devices" / "1-2"
        device.mkdir(parents=True)
        for name, value in (("idVendor", "04b4"), ("idProduct", "00f5"), ("busnum", "1"), ("devnum", "4")):
            (device / name).write_text(value + "\n")
        (tmp_path / "nodes" / "001").mkdir(parents=True)
        return tmp_path / "devices"

    def test_no_camera_is_no_fault(self, tmp_path):
        found = installation.check_cameras(tmp_path / "none", tmp_path)
        assert (found.level, found.state) == ("info", "none: this machine has no USB bus")
        assert installation.check_cameras(tmp_path, tmp_path).state == "none on USB"

    def test_a_camera_without_permission_is_bad(self, devices):
        found = installation.check_cameras(devices, devices.parent / "nodes")
        assert (found.level, found.state) == ("bad", "no permission: 04b4:00f5 (Prophesee EVK3 or EVK4)")
        assert "neurove cameras" in found.advice

    def test_a_camera_that_may_be_used_is_ok(self, devices):
        nodes = devices.parent / "nodes"
        (nodes / "001" / "004").touch()
        assert installation.check_cameras(devices, nodes).level == "ok"


@pytest.mark.parametrize(
    ("text", "names"),
    [
        (
            "processor : 0\nflags : fpu sse2 avx2 avx512f avx512_vnni avx_vnni\n",
            ["AVX2", "AVX-512", "VNNI", "AVX-VNNI"],
        ),
        ("Features : fp asimd aes\n", ["NEON"]),
        ("flags : fpu sse2\n", []),
        ("", []),
    ],
)
def test_vector_instructions_are_read_from_cpuinfo(tmp_path, text, names):
    (tmp_path / "cpuinfo").write_text(text)
    assert installation.cpu_features(tmp_path / "cpuinfo") == names
    assert installation.cpu_features(tmp_path / "missing") == []


def test_an_extra_that_is_not_installed_is_named_with_its_modules(monkeypatch):
    monkeypatch.setitem(extras.EXTRAS, "carla", ("no_such_module",))
    found = {check.what: check for check in installation.check_extras()}["extra carla"]
    assert (found.level, found.state) == ("info", "not installed: no_such_module")


@pytest.mark.parametrize(
    ("flags", "state", "level"),
    [
        (("unscaled",), "unknown to the service, which assumes 1 m", "bad"),
        (("uncalibrated", "unscaled"), "unknown to the service, which assumes 1 m", "bad"),
        (("gap",), "known", "ok"),
        (None, "unknown: no estimate within 2 s", "info"),
    ],
)
def test_the_height_of_a_stream_is_known_by_the_flags_of_its_newest_estimate(flags, state, level):
    estimate = None if flags is None else TwistEstimate.model_validate(EXAMPLES["TwistEstimate"] | {"flags": flags})
    found = {check.what: check for check in doctor.check_stream(status(), estimate)}["stream cam0: height"]
    assert (found.state, found.level) == (state, level)
    assert ("--height M" in found.advice) == (level == "bad")


def status(**changes):
    return StreamStatus.model_validate(STATUS).model_copy(
        update={"stream": "cam0", "verdict": "ok", "imu": None} | changes
    )


class Estimate:
    def __init__(self, *flags):
        self.flags = flags


@pytest.mark.parametrize(
    ("changes", "estimate", "levels"),
    [
        ({"calibrated": True, "last_packet_age_s": 0.1}, Estimate(), ["ok", "ok", "ok", "ok"]),
        ({"calibrated": False, "last_packet_age_s": 0.1}, Estimate(Flag.UNSCALED), ["ok", "ok", "bad", "bad"]),
        ({"calibrated": True, "last_packet_age_s": 9.0}, None, ["ok", "bad", "ok", "info"]),
        ({"calibrated": True, "last_packet_age_s": 0.1, "verdict": "stalled"}, None, ["ok", "bad", "ok", "info"]),
        ({"calibrated": True, "last_packet_age_s": 0.1, "verdict": "unstable"}, Estimate(), ["bad", "ok", "ok", "ok"]),
    ],
)
def test_each_stream_is_checked_for_feed_clock_calibration_and_height(changes, estimate, levels):
    found = doctor.check_stream(status(**changes), estimate)
    assert [check.level for check in found] == levels
    assert all(check.advice for check in found if check.level == "bad")


@pytest.mark.parametrize(
    ("changes", "level", "state"),
    [
        (
            {"disagrees": False, "problem": ""},
            "ok",
            "inertial unit 1,000 Hz, gyroscope bias +0.0625 +0.0000",
        ),
        ({"disagrees": False, "problem": "no packet for 3.0 s"}, "bad", "inertial unit: no packet for 3.0 s"),
        ({"disagrees": True, "problem": "it turns the other way"}, "bad", "gyroscope disagrees with the events"),
    ],
)
def test_the_inertial_unit_of_a_stream_is_checked_if_it_has_one(changes, level, state):
    unit = StreamStatus.model_validate(STATUS).imu.model_copy(update=changes)
    check = doctor.check_stream(status(imu=unit, calibrated=True, last_packet_age_s=0.1), Estimate())[-1]
    assert (check.what, check.level) == ("stream cam0: inertial unit", level)
    assert check.state.startswith(state)
    assert bool(check.advice) == (level == "bad")


def replies_of(**roles):
    """Health replies of nodes that serve one stream; a node without a role does not stand by."""
    made = EXAMPLES["HealthReply"]
    return [
        HealthReply(
            **(made | {"node": node, "streams": [STATUS | {"stream": "cam0", "standby": role and duty(**role)}]})
        )
        for node, role in roles.items()
    ]


def duty(role, *, equal=False):
    return {"role": role, "leader": "a", "term": 7, "equal": equal}


@pytest.mark.parametrize(
    ("roles", "level", "state"),
    [
        ({"a": {"role": "answers"}, "b": {"role": "follows", "equal": True}}, "ok", "a answers; b follows, ready"),
        ({"a": {"role": "answers"}, "b": {"role": "follows"}}, "bad", "a answers; b follows, not ready"),
        ({"a": {"role": "answers"}}, "bad", "a answers; no other node serves it"),
        ({"a": {"role": "answers"}, "b": None}, "bad", "b publishes without standby"),
    ],
)
def test_standby_says_who_answers_and_whether_another_node_is_ready(roles, level, state):
    (check,) = doctor.check_standby("cam0", replies_of(**roles))
    assert (check.level, check.state.startswith(state)) == (level, True), check


def test_a_stream_without_standby_has_no_such_check_and_its_status_is_that_of_the_node_that_answers():
    assert doctor.check_standby("cam0", replies_of(a=None)) == []
    replies = replies_of(a={"role": "answers"}, b={"role": "follows"})
    assert doctor.answering(replies)["cam0"].standby.role == "answers"
    assert doctor.answering(replies[::-1])["cam0"].standby.role == "answers"
