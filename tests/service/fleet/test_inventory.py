"""The file of expected nodes."""

from datetime import UTC, datetime

import pytest

from neurove_protocol.errors import InvalidField
from neurove_service.fleet import inventory
from neurove_service.fleet.inventory import Expected

NOW = datetime(2026, 11, 29, 20, 6, 29, tzinfo=UTC)
TEXT = """# hall 2
rover-1 site=hall-2 seen=2026-11-28T00:00:00Z   # the red one

rover-2 site=hall-2
rover-3
"""


def test_names_labels_and_times_are_read(tmp_path):
    file = tmp_path / "nodes.txt"
    file.write_text(TEXT)
    assert inventory.read(file) == {
        "rover-1": Expected({"site": "hall-2"}, datetime(2026, 11, 28, tzinfo=UTC)),
        "rover-2": Expected({"site": "hall-2"}),
        "rover-3": Expected({}),
    }


def test_an_update_changes_only_the_nodes_that_answered(tmp_path):
    file = tmp_path / "nodes.txt"
    file.write_text(TEXT)
    inventory.update(file, {"rover-1": {"site": "hall-3"}, "rover-3": {}, "new": {"robot": "spot"}}, NOW)
    seen = "seen=2026-11-29T20:06:29Z"
    assert file.read_text().splitlines() == [
        "# hall 2",
        f"rover-1 site=hall-3 {seen}   # the red one",
        "",
        "rover-2 site=hall-2",
        f"rover-3 {seen}",
        f"new robot=spot {seen}",
    ]
    assert inventory.read(file)["rover-1"] == Expected({"site": "hall-3"}, NOW)


def test_an_update_creates_the_file(tmp_path):
    inventory.update(tmp_path / "nodes.txt", {"a": {}}, NOW)
    assert inventory.read(tmp_path / "nodes.txt") == {"a": Expected({}, NOW)}


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("a/b", "node 'a/b' is not valid: 1 to 64 characters"),
        ("a site", "'site': give NAME=VALUE"),
        ("a site=x site=y", "label 'site' occurs twice"),
        ("a model=x", "this name is reserved"),
        ("a seen=yesterday", "does not match"),
        ("rover-0", "node 'rover-0' occurs twice"),
    ],
)
def test_a_wrong_line_is_named_with_its_number(tmp_path, line, words):
    file = tmp_path / "nodes.txt"
    file.write_text(f"rover-0\n# x\n{line}\n")
    with pytest.raises(InvalidField, match=f"nodes.txt, line 3.*{words}"):
        inventory.read(file)


def test_a_binary_file_is_refused(tmp_path):
    (tmp_path / "x").write_bytes(b"\xff\xfe")
    with pytest.raises(InvalidField, match="not a text file"):
        inventory.read(tmp_path / "x")
