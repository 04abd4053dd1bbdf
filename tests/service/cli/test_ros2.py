"""neurove ros2: wrong arguments are refused before anything is opened."""

import pytest

from neurove_protocol.errors import EXIT_WRONG_USAGE

MATRIX = "0 0 1 0\n-1 0 0 0\n0 -1 0 0.3\n0 0 0 1\n"


@pytest.mark.parametrize(
    ("flags", "why"),
    [
        (("--events", "events"), "--events='events': a full name such as /event_camera/events"),
        (("--events", "/a/ev ents"), "a full name such as"),
        (("--events", "/a/events", "--stream", "cam-0"), "--stream='cam-0': 1 to 64 letters, digits and _"),
        (("--events", "/a/events", "--domain", "233"), "--domain=233: 0 to 232"),
        (("--events", "/a/events", "--namespace", "neurove"), "--namespace='neurove': a full name"),
        (("--events", "/a/events", "--extrinsics", "pose.txt"), "it needs --frame NAME"),
        (
            ("--events", "/a/events", "--frame", "base_link", "--extrinsics", "short.txt"),
            "numbers=3: expected the 16 numbers",
        ),
        (("--events", "/a/events", "--events", "/b/events", "--stream", "a"), "one different name for each of the 2"),
        (("--events", "/a/events", "--events", "/b/events", "--stream", "a", "--stream", "a"), "one different name"),
        (("--events", "/a/events", "--imu-axes", "x,x,z"), "they are no rotation"),
        (("--events", "/a/events", "--ros-connect", "nowhere"), "--ros-connect='nowhere'"),
    ],
)
def test_a_wrong_argument_is_refused_with_its_bound(run, tmp_path, monkeypatch, flags, why):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pose.txt").write_text(MATRIX)
    (tmp_path / "short.txt").write_text("1 2 3\n")
    ran = run("ros2", *flags, "--connect", "tcp/127.0.0.1:9", "--wait", "0")
    assert (ran.code, ran.out) == (EXIT_WRONG_USAGE, "")
    assert why in ran.err
    assert ran.err.count("\n") == 1


def test_without_a_router_the_command_says_so(run):
    ran = run("ros2", "--events", "/a/events", "--connect", "tcp/127.0.0.1:9", "--wait", "0")
    assert ran.code == 1
    assert "no service: no process listens at tcp/127.0.0.1:9" in ran.err
