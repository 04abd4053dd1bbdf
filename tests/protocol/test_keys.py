"""Keys: what is built is parsed back, and no name leads out of its place."""

import inspect
from collections.abc import Callable

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from neurove_protocol import NeuroVEError
from neurove_protocol.errors import InvalidField
from neurove_protocol.keys import DEFAULT_PREFIX, NAME_RULE, Keys, check_name, is_name
from tests.protocol.messages import bounded, names

STREAM_KEYS: list[Callable[..., str]] = [Keys.events, Keys.camera, Keys.imu, Keys.velocity, Keys.status]
NODE_KEYS: list[Callable[..., str]] = [
    Keys.health,
    Keys.models,
    Keys.push,
    Keys.activate,
    Keys.rollback,
    Keys.alive,
    Keys.serves,
    Keys.instance,
    Keys.duty,
    Keys.state,
    Keys.take,
    Keys.drain,
    Keys.shares,
]
NO_NAMES = ["", "*", "**", "@node", "@", "a/b", "/", "a/", "/a", "..", ".", "-", "$*", "a$*", "a b", "#", "?", "a" * 65]
NO_NAMES += ["a\n", "\n", "caf\u00e9", "\u0661", "a\x00"]
prefixes = st.lists(st.sampled_from(["neurove", "v1", "site-1", "_", "."]), min_size=1, max_size=8).map("/".join)


def test_the_lists_of_this_test_are_complete() -> None:
    built = {name for name, member in inspect.getmembers(Keys, inspect.isfunction) if not name.startswith("_")}
    assert built - {"stream_of", "node_of", "served_of", "shared_of", "chunks"} == {
        build.__name__ for build in (*STREAM_KEYS, *NODE_KEYS)
    }


@pytest.mark.parametrize("build", STREAM_KEYS)
@bounded
@given(prefix=prefixes, stream=names)
def test_the_stream_of_a_built_key_is_the_stream_it_was_built_for(
    build: Callable[..., str], prefix: str, stream: str
) -> None:
    keys = Keys(prefix)
    key = build(keys, stream)
    assert keys.stream_of(key) == stream
    assert key == f"{prefix}/{stream}/{build.__name__}"


@bounded
@given(st.text(max_size=70))
@example("@node")
@example("*")
@example("**")
@example("a/events")
@example("")
def test_a_stream_name_stays_one_chunk_in_its_place_or_is_refused(stream: str) -> None:
    keys = Keys()
    for build in STREAM_KEYS:
        if stream == "*" or is_name(stream):
            assert build(keys, stream).split("/") == [*DEFAULT_PREFIX.split("/"), stream, build.__name__]
            assert stream == "*" or not set("@*$#?/") & set(stream)
        else:
            with pytest.raises(InvalidField) as caught:
                build(keys, stream)
            assert (caught.value.details["field"], caught.value.details["bound"]) == ("stream", NAME_RULE)


@bounded
@given(st.text(max_size=70))
@example("@node")
@example("n1/model/activate")
@example("**")
def test_a_node_name_stays_one_chunk_in_its_place_or_is_refused(node: str) -> None:
    for build in NODE_KEYS:
        if node == "*" or is_name(node):
            chunks = build(Keys("p"), node).split("/")
            assert chunks[:3] == ["p", "@node", node]
            assert len(chunks) == len(build(Keys("p"), "n1").split("/"))
        else:
            with pytest.raises(InvalidField) as caught:
                build(Keys("p"), node)
            assert caught.value.details["field"] == "node"


@pytest.mark.parametrize("name", NO_NAMES, ids=repr)
def test_what_is_no_name_is_refused_everywhere(name: str) -> None:
    assert not is_name(name)
    with pytest.raises(InvalidField):
        check_name("stream", name)
    for build in (Keys().events, Keys().health, lambda value: Keys().serves("n1", value)):
        if name != "*":
            with pytest.raises(NeuroVEError):
                build(name)
    with pytest.raises(InvalidField):
        Keys().stream_of(f"{DEFAULT_PREFIX}/{name}/events")


@pytest.mark.parametrize("name", ["a", "_", "0", "A.b-c_d", "a" * 64, "node", "events", "camera-2.left"])
def test_what_is_a_name_is_given_back(name: str) -> None:
    assert check_name("stream", name) == name


@pytest.mark.parametrize(
    "key",
    [
        "",
        "cam0/events",
        DEFAULT_PREFIX,
        f"{DEFAULT_PREFIX}/",
        f"{DEFAULT_PREFIX}/cam0",
        f"{DEFAULT_PREFIX}/cam0/",
        f"{DEFAULT_PREFIX}//events",
        f"{DEFAULT_PREFIX}/cam0/events/more",
        f"{DEFAULT_PREFIX}x/cam0/events",
        f"x/{DEFAULT_PREFIX}/cam0/events",
        f"/{DEFAULT_PREFIX}/cam0/events",
        Keys().events(),
        Keys().health("n1"),
        Keys().activate("n1"),
        Keys().serves("n1", "cam0"),
        Keys("other/v1").events("cam0"),
    ],
)
def test_a_key_that_is_no_stream_key_has_no_stream(key: str) -> None:
    with pytest.raises(InvalidField):
        Keys().stream_of(key)


def test_a_wildcard_matches_any_one_name_and_never_a_node() -> None:
    assert Keys().events() == "neurove/v1/*/events"
    assert Keys().serves() == "neurove/v1/@node/*/serves/*"
    assert all("@node" not in build(Keys()) for build in STREAM_KEYS)
    assert all("/@node/" in build(Keys()) for build in NODE_KEYS)


def test_the_model_of_a_node_is_changed_below_a_chunk_of_its_own() -> None:
    assert Keys().activate("n1") == "neurove/v1/@node/n1/model/activate"
    assert Keys().push("n1") == "neurove/v1/@node/n1/model/push"
    assert Keys().rollback("n1") == "neurove/v1/@node/n1/model/rollback"
    assert not Keys().models("n1").startswith("neurove/v1/@node/n1/model/")


@pytest.mark.parametrize("build", [build for build in NODE_KEYS if build is not Keys.serves])
@bounded
@given(prefix=prefixes, node=names)
def test_the_node_of_a_built_key_is_the_node_it_was_built_for(
    build: Callable[..., str], prefix: str, node: str
) -> None:
    assert Keys(prefix).node_of(build(Keys(prefix), node)) == node


@pytest.mark.parametrize(
    "key", ["", "n1/alive", "neurove/v1/@node/n1", "neurove/v1/@node/*/alive", Keys().events("cam0")]
)
def test_a_key_that_is_no_node_key_has_no_node(key: str) -> None:
    with pytest.raises(InvalidField):
        Keys().node_of(key)


@bounded
@given(st.text(max_size=70))
@example("5e" * 32)
@example("5e" * 32 + "\n")
@example("*")
@example("../" * 20)
def test_only_a_digest_makes_a_key_for_chunks(digest: str) -> None:
    if len(digest) == 64 and set(digest) <= set("0123456789abcdef"):
        assert Keys("p").chunks(digest) == f"p/@push/{digest}"
    else:
        with pytest.raises(InvalidField) as caught:
            Keys("p").chunks(digest)
        assert caught.value.details["field"] == "digest"


def test_all_keys_of_one_stream_and_node_are_different() -> None:
    built = [build(Keys(), "same") for build in (*STREAM_KEYS, *NODE_KEYS)]
    assert len(set(built)) == len(built)


@pytest.mark.parametrize(
    "prefix", ["", "/", "a/", "/a", "a//b", "*", "a/**", "@a", "a/@b", "a b", "a\n", "/".join("a" * 9)]
)
def test_a_prefix_that_is_no_key_is_refused(prefix: str) -> None:
    with pytest.raises(InvalidField) as caught:
        Keys(prefix)
    assert caught.value.details["field"] == "prefix"
