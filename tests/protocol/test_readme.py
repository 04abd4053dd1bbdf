"""The contract in protocol/README.md says what the code does: its dumps, its tables, its examples.

A dump is a block fenced as ```hex <Message>, bytes to the left of each bar, followed by a ```json block with the
message. A table is found by the heading of its first column, and by the section it stands in.
"""

import ast
import importlib
import inspect
import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import msgpack
import numpy as np
import pytest
from pydantic import BaseModel

import neurove_protocol
from neurove_protocol import (
    EventPacket,
    Events,
    Flag,
    HostTime,
    Imu,
    ImuPacket,
    Sensor,
    Trace,
    TwistEstimate,
    camera,
    control,
    events,
    imu,
    velocity,
)
from neurove_protocol.codec import PROTOCOL_VERSION
from neurove_protocol.control import (
    LATENCY_BOUNDS_MS,
    ImuStatus,
    Latency,
    LatencyHistogram,
    Losses,
    ModelInfo,
    StandbyStatus,
    Verdict,
)
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import DEFAULT_LIMITS, FORMATS, PacketLimits, decode_packet, encode_packet
from neurove_protocol.imu import decode_imu, encode_imu
from neurove_protocol.keys import Keys
from neurove_protocol.velocity import AXES
from neurove_service.models.progress import Step
from tests.protocol.messages import KINDS, MODELS, assert_same_imu, assert_same_packet
from tests.protocol.test_errors import ERRORS

ROOT = Path(__file__).parents[2]
README = Path(neurove_protocol.__file__).with_name("README.md").read_text(encoding="utf-8")
DUMPS = re.findall(r"```hex (\w+)\n(.*?)```\n\n```json\n(.*?)```", README, re.DOTALL)
EXAMPLES = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
BY_NAME = {model.__name__: model for model in MODELS}
ids = [f"{name}-{number}" for number, (name, _, _) in enumerate(DUMPS)]


def bytes_of(dump: str) -> bytes:
    return bytes.fromhex("".join(line.partition("|")[0] for line in dump.splitlines()))


def packet_of(said: dict[str, Any]) -> EventPacket:
    t, x, y, p = zip(*said["events"], strict=True) if said["events"] else ((), (), (), ())
    sensor = Sensor(said["width"], said["height"])
    events = Events.from_columns(t, x, y, p)
    return EventPacket(said["stream"], said["seq"], sensor, said["t0_us"], events)


def imu_packet_of(said: dict[str, Any]) -> ImuPacket:
    t, *columns = (np.array(said[name]) for name in Imu._fields)
    return ImuPacket(said["stream"], said["seq"], Imu(t, *columns))


def section(heading: str) -> str:
    """The text below this heading up to the next one of any level."""
    return re.split(r"^#+ ", README.split(f"\n{heading}\n", 1)[1], maxsplit=1, flags=re.MULTILINE)[0]


def tables(text: str = README) -> Iterator[list[list[str]]]:
    """Every table, as rows of cells; the first row is the heading."""
    for block in re.findall(r"(?:^\|.*\|\n)+", text, re.MULTILINE):
        rows = [[cell.strip() for cell in line.strip().strip("|").split("|")] for line in block.splitlines()]
        yield [rows[0], *rows[2:]]


def table(first_column: str, text: str = README) -> list[list[str]]:
    """The rows below the only table whose first column has this heading."""
    (found,) = [rows for rows in tables(text) if rows[0][0] == first_column]
    assert all(len(row) == len(found[0]) for row in found)
    return found[1:]


def code(cell: str) -> list[str]:
    """What stands in back ticks."""
    return re.findall(r"`([^`]*)`", cell)


def column(rows: list[list[str]]) -> list[str]:
    """The names in the first column."""
    return [name for row in rows for name in code(row[0])]


# --- dumps


def test_there_is_a_dump_of_every_message_and_no_hex_outside_of_a_dump() -> None:
    assert {name for name, _, _ in DUMPS} == {kind.name for kind in KINDS}
    assert README.count("```hex") == README.count("```json") == len(DUMPS)
    assert {said["format"] for said in (json.loads(dump[2]) for dump in DUMPS) if "format" in said} == set(FORMATS)
    assert any(json.loads(said).get("events") == [] for _, _, said in DUMPS)


@pytest.mark.parametrize(("name", "dump", "said"), DUMPS, ids=ids)
def test_a_dump_decodes_to_the_message_that_the_page_says_and_encodes_back(name: str, dump: str, said: str) -> None:
    data, message = bytes_of(dump), json.loads(said)
    if name == "EventPacket":
        assert message["v"] == PROTOCOL_VERSION
        assert_same_packet(decode_packet(data), packet_of(message))
        assert encode_packet(packet_of(message), message["format"]) == data
    elif name == "ImuPacket":
        assert (message["v"], message["n"]) == (PROTOCOL_VERSION, len(message["t"]))
        assert_same_imu(decode_imu(data), imu_packet_of(message))
        assert encode_imu(imu_packet_of(message)) == data
    else:
        model = BY_NAME[name]
        assert json.loads(model.decode(data).model_dump_json()) == message
        assert model.decode(data).encode() == data
        assert model.model_validate_json(said).encode() == data


@pytest.mark.parametrize(("name", "dump", "said"), DUMPS, ids=ids)
def test_the_names_and_values_on_the_right_are_those_of_the_bytes_on_the_left(name: str, dump: str, said: str) -> None:
    for line in dump.splitlines():
        left, meaning = (part.strip() for part in line.split("|"))
        named = re.match(r"(\w+) = (.*?)(?:; .*)?$", meaning)
        if named:
            head = msgpack.packb(named[1])
            assert bytes.fromhex(left).startswith(head), line
            assert msgpack.unpackb(bytes.fromhex(left)[len(head) :]) == json.loads(named[2]), line


@pytest.mark.parametrize(("name", "dump", "said"), DUMPS, ids=ids)
def test_a_dump_shows_every_field_of_its_message(name: str, dump: str, said: str) -> None:
    assert list(msgpack.unpackb(bytes_of(dump))) == column(table("field", section(f"### {name}")))


# --- tables


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.__name__)
def test_the_table_of_a_message_has_its_fields_and_says_which_have_a_default(model: type[BaseModel]) -> None:
    assert_fields(table("field", section(f"### {model.__name__}")), model)


@pytest.mark.parametrize(
    ("heading", "part"),
    [
        ("`trace`", Trace),
        ("`host`", HostTime),
        ("`lost`", Losses),
        ("`latency_ms`", Latency),
        ("`latency_histogram`", LatencyHistogram),
        ("`imu`", ImuStatus),
        ("`standby`", StandbyStatus),
        ("ModelInfo", ModelInfo),
    ],
    ids=["trace", "host", "lost", "latency", "histogram", "imu", "standby", "model"],
)
def test_the_table_of_a_part_has_its_fields_and_says_which_have_a_default(heading: str, part: type[BaseModel]) -> None:
    assert_fields(table(f"field of {heading}"), part)


def assert_fields(rows: list[list[str]], model: type[BaseModel]) -> None:
    assert column(rows) == list(model.model_fields)
    assert [row[0].strip("`") for row in rows if "default" in row[3]] == [
        name for name, field in model.model_fields.items() if not field.is_required() and name != "v"
    ]


def test_the_table_of_keys_has_all_keys_and_no_other() -> None:
    names = {
        "prefix": Keys().prefix,
        "stream": "cam0",
        "node": "n1",
        "instance": "0a",
        "capacity": "2",
        "digest": "5e" * 32,
    }
    told = {re.sub(r"<(\w+)>", lambda part: names[part[1]], key) for key in column(table("key"))}
    built = set()
    for name, _ in inspect.getmembers(Keys, inspect.isfunction):  # of the class: Python 3.11.2 fails on a Keys()
        if not name.startswith("_") and name not in ("stream_of", "node_of", "served_of", "shared_of"):
            build = getattr(Keys(), name)
            built.add(build(**{part: names[part] for part in inspect.signature(build).parameters}))
    assert told == built
    assert f"by default `{Keys().prefix}`" in README


def test_the_table_of_encodings_has_all_schemas() -> None:
    schemas = [events.SCHEMA, camera.SCHEMA, imu.SCHEMA, velocity.SCHEMA, control.STATUS_SCHEMA, control.CONTROL_SCHEMA]
    schemas += [control.PROGRESS_SCHEMA, control.CHUNK_SCHEMA]
    assert column(table("encoding")) == schemas
    assert all(schema.endswith(f".{PROTOCOL_VERSION}") for schema in schemas if schema != control.CHUNK_SCHEMA)


def test_the_table_of_error_codes_has_all_codes_with_their_details() -> None:
    told = {code(row[0])[0]: code(row[1]) for row in table("`code`")}
    assert told == {error.code: list(error.details) for error in ERRORS}


def test_the_table_of_flags_has_all_flags() -> None:
    assert column(table("`flags`")) == [flag.value for flag in Flag]


def test_the_table_of_steps_has_all_steps() -> None:
    assert column(table("`step`")) == list(get_args(Step))


def test_the_page_lists_all_verdicts_and_lenses() -> None:
    cells = {row[0]: code(row[3]) for rows in tables() for row in rows if rows[0][0] == "field"}
    assert cells["`verdict`"] == list(get_args(Verdict))
    assert cells["`lens`"] == list(get_args(camera.CameraInfo.model_fields["lens"].annotation))


def test_the_table_of_formats_has_all_formats_with_their_sizes() -> None:
    rows = table("format")
    assert column(rows) == list(FORMATS)
    for row, column_bytes in zip(rows, (2, 4), strict=True):
        assert int(row[4]) == column_bytes + 4
        assert row[5] == f"{256**column_bytes - 1} us"


def test_the_caps_are_those_of_the_code() -> None:
    for name, value, _ in table("cap"):
        module, *path = code(name)[0].split(".")
        found: object = importlib.import_module(f"neurove_protocol.{module}")
        for part in path:
            found = getattr(found, part)
        assert found == int(value), name


def test_the_page_gives_the_order_of_a_twist() -> None:
    assert f"{' '.join(AXES[:3])} [m/s] and {' '.join(AXES[3:])} [rad/s]" in section("### TwistEstimate")
    assert f"default `{TwistEstimate.model_fields['frame_id'].default}`" in section("### TwistEstimate")


def test_the_page_gives_the_bounds_of_the_buckets() -> None:
    said = " ".join(section("### StreamStatus").split())
    assert ", ".join(f"{bound:g}" for bound in LATENCY_BOUNDS_MS) + " ms" in said


def test_the_links_of_the_page_lead_to_its_sections() -> None:
    sections = {
        re.sub(r"[^a-z0-9 ]", "", line.lower()).replace(" ", "-") for line in re.findall(r"^#+ (.*)", README, re.M)
    }
    assert set(re.findall(r"\]\(#([^)]*)\)", README)) <= sections


# --- the picture


def test_the_picture_names_only_files_and_keys_that_exist() -> None:
    picture = re.findall(r"```mermaid\n(.*?)```", README, re.DOTALL)[0]
    files = set(re.findall(r"\b(?:service|neurove_core|protocol)/[\w/]+\.py", picture))
    assert len(files) >= 10
    assert all((ROOT / file).is_file() for file in files), [file for file in files if not (ROOT / file).is_file()]
    drawn = {re.sub(r"[{}]", "`", key).replace("`", "") for key in re.findall(r"\{prefix\}[\w/@{}]*", picture)}
    table_of_keys = {re.sub(r"[<>]", "", key) for key in column(table("key"))}
    assert len(drawn) >= 8
    assert drawn <= table_of_keys


# --- the driver in C


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_the_driver_in_c_compiles_without_a_warning_and_writes_the_packet_of_the_first_dump(tmp_path: Path) -> None:
    (source,) = re.findall(r"```c\n(.*?)```", README, re.DOTALL)
    (tmp_path / "packet.c").write_text(source)
    flags = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-o", str(tmp_path / "packet")]
    made = subprocess.run(["cc", *flags, str(tmp_path / "packet.c")], capture_output=True, text=True, check=False)
    assert (made.returncode, made.stderr) == (0, "")
    data = subprocess.run([tmp_path / "packet"], capture_output=True, check=True).stdout
    said = json.loads(DUMPS[0][2])
    assert_same_packet(decode_packet(data), packet_of(said))
    told = msgpack.unpackb(data)
    assert list(told) == list(msgpack.unpackb(bytes_of(DUMPS[0][1])))  # the same fields
    assert told == msgpack.unpackb(bytes_of(DUMPS[0][1]))


def test_the_answers_quote_what_the_code_says() -> None:
    answers = " ".join(section("## Questions of a driver author").split())
    assert (
        f"`max_packet_events` ({DEFAULT_LIMITS.max_events:,}) and `max_side_px` ({DEFAULT_LIMITS.max_side_px})"
        in answers
    )
    packet = EventPacket("cam0", 0, Sensor(8, 8), 0, Events.from_columns(*([[0] * 3] * 4)))
    with pytest.raises(InvalidField) as refused:
        decode_packet(encode_packet(packet), PacketLimits(max_events=2))
    shape = refused.value.message.replace("n=3", "n=2000000").replace("cap is 2", "cap is 1000000")
    assert f"`{shape}`" in answers


# --- the examples


@pytest.mark.parametrize(("example", "lines"), list(zip(EXAMPLES, (20, 10), strict=True)), ids=["driver", "consumer"])
def test_an_example_is_short_and_uses_only_what_the_package_has(example: str, lines: int) -> None:
    known = {"camera": camera, "events": events, "key": Keys}
    assert len([line for line in example.splitlines() if line]) <= lines
    for node in ast.walk(ast.parse(example)):
        if isinstance(node, ast.Import):
            assert {name.name for name in node.names} <= {"time", "numpy", "zenoh"}
        if isinstance(node, ast.ImportFrom):
            module = importlib.import_module(str(node.module))
            assert module.__name__.partition(".")[0] == "neurove_protocol"
            assert all(hasattr(module, name.name) for name in node.names)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in known:
            assert hasattr(known[node.value.id], node.attr)
