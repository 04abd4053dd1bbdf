"""The optional header fields: saved and loaded unchanged, absent in old bundles, and always checked."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import neurove_core
from neurove_core.models import bundle, container, golden, manifest
from neurove_core.models.bundle import Header
from neurove_core.models.metadata import BundleLimits, MadeBy, Metadata
from neurove_protocol.errors import BadModel
from tests.bundles import CONFIG, DATA, ORIGINAL, join_header, refusal, split_header, with_entries, with_fields

METADATA = Metadata(
    release=7,
    figures={"heldout_re_v_l": 0.19, "heldout_rmse_v_l_m_s": 1.49},
    made_by=MadeBy(
        program="neurove train night",
        seed=3,
        commit="93cc177",
        torch="2.13.0",
        updates=4400,
        cpu_s=1090.4,
        recipe={"gain": [0.5, 4.0], "nested": {"deep": [None, True, "x"]}},
        data={"sequences": 112},
    ),
    prime_windows=40,
    limits=BundleLimits(mean_dv_m_s=1.5, latency_ratio=2.0),
)

PATHS = [
    ("release",),
    ("figures",),
    ("figures", "heldout_re_v_l"),
    ("made_by",),
    ("made_by", "seed"),
    ("made_by", "recipe"),
    ("made_by", "recipe", "nested", "deep"),
    ("limits", "mean_dv_m_s"),
    ("prime_windows",),
    ("golden_tolerance",),
    ("config",),
    ("config", "network", "channels"),
    ("config", "canonical", "width"),
    ("config", "window"),
    ("linear_unit",),
    ("name",),
    ("bundle_version",),
]
VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.integers(min_value=-(1 << 200), max_value=1 << 200)
    | st.floats()
    | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)


def bytes_with_metadata() -> bytes:
    return replace(ORIGINAL, metadata=METADATA).to_bytes()


def edited(path, value):
    """The bytes of the bundle with metadata, with the header field at a path replaced."""

    def edit(fields):
        for step in path[:-1]:
            fields = fields[step]
        fields[path[-1]] = value

    return with_fields(edit, bytes_with_metadata())


def test_metadata_is_saved_and_loaded_unchanged():
    loaded = bundle.from_bytes(bytes_with_metadata(), "x")
    assert loaded.metadata == METADATA
    assert (loaded.release, loaded.prime_windows, loaded.limits.mean_dv_m_s) == (7, 40, 1.5)
    assert loaded.to_bytes() == bytes_with_metadata()


def test_a_bundle_without_metadata_has_only_the_required_header_fields():
    fields = json.loads(split_header(DATA)[0]["__metadata__"]["neurove"])
    assert list(fields) == [
        "bundle_version",
        "name",
        "trained",
        "provenance",
        "config",
        "linear_unit",
    ]
    loaded = bundle.from_bytes(DATA, "x")
    assert (loaded.release, loaded.limits, loaded.metadata.made_by) == (0, BundleLimits(), None)
    assert loaded.prime_windows == CONFIG.settle_windows


def test_prime_windows_may_be_zero():
    assert bundle.from_bytes(edited(("prime_windows",), 0), "x").prime_windows == 0


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (("release",), -1, ("release=-1", "greater than or equal to 0")),
        (("release",), 1 << 63, ("release=", "less than or equal to")),
        (("release",), 1.5, ("release=1.5", "integer")),
        (("figures", "heldout_re_v_l"), float("nan"), ("figures.heldout_re_v_l=nan", "finite")),
        (("figures", "heldout_re_v_l"), "good", ("figures.heldout_re_v_l='good'", "number")),
        (("figures", "two words"), 1.0, ("figures.two words", "pattern")),
        (("figures",), {f"f{i}": 0.0 for i in range(65)}, ("figures=", "at most 64")),
        (("made_by", "seed"), -1, ("made_by.seed=-1", "greater than or equal to 0")),
        (("made_by", "recipe"), {"rate": float("inf")}, ("made_by.recipe.rate", "=inf", "finite")),
        (("made_by", "host"), "mine", ("made_by.host='mine'", "not permitted")),
        (("prime_windows",), 257, ("prime_windows=257", "less than or equal to 256")),
        (("limits", "latency_ratio"), 0, ("limits.latency_ratio=0", "greater than 0")),
        (("golden_tolerance",), 2, ("golden_tolerance=2", "less than or equal to 1")),
        (("golden_tolerance",), 0.1, ("tensor 'golden.seen' is missing",)),
    ],
    ids=range(14),
)
def test_a_wrong_field_is_named_with_its_value_and_bound(path, value, words):
    message = refusal(edited(path, value))
    for word in words:
        assert word in message


@pytest.mark.parametrize("depth", [100, 240, 300, 900, 5_000, 100_000])
def test_a_deeply_nested_recipe_is_accepted_or_refused_with_a_short_message(depth):
    entries, tensors = split_header(bytes_with_metadata())
    text = entries["__metadata__"]["neurove"].replace('{"sequences":112}', '{"x":' + "[" * depth + "]" * depth + "}")
    entries["__metadata__"]["neurove"] = text
    data = join_header(json.dumps(entries).encode(), tensors)
    if depth < 250:
        assert bundle.from_bytes(data, "x").metadata.made_by is not None
    else:
        assert len(refusal(data)) < 500


@given(path=st.sampled_from(PATHS), value=VALUES)
def test_any_value_in_any_field_is_accepted_or_refused_with_a_short_message(path, value):
    data = edited(path, value)
    try:
        loaded = bundle.from_bytes(data, "x")
    except BadModel:
        assert len(refusal(data)) < 500
    else:
        assert bundle.from_bytes(loaded.to_bytes(), "x").metadata == loaded.metadata


@given(st.dictionaries(st.text(max_size=12), VALUES, max_size=6))
def test_random_headers_are_refused(fields):
    refusal(join_header(json.dumps({"__metadata__": {"neurove": json.dumps(fields)}}).encode()))
    refusal(join_header(json.dumps(fields).encode()))


def test_two_hundred_thousand_empty_tensors_are_refused_before_any_is_created():
    empty = {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]}
    message = refusal(with_entries(lambda entries: entries.update({f"t{i}": empty for i in range(200_000)})))
    assert f"over {container.MAX_HEADER_BYTES} bytes" in message


def test_a_pickle_is_refused_and_none_of_its_opcodes_runs(tmp_path):
    import pickle

    class Trap:
        def __reduce__(self):
            return open, (str(tmp_path / "sprung"), "w")

    refusal(pickle.dumps(Trap()))
    assert not list(tmp_path.iterdir())


def test_the_page_of_the_format_names_every_field_and_limit():
    page = (Path(neurove_core.__file__).parent / "BUNDLE.md").read_text()
    named = [*Header.model_fields, *MadeBy.model_fields, *BundleLimits.model_fields, *manifest.Signed.model_fields]
    named += [*bundle.UncertaintyHeader.model_fields, "spread.weight", "spread.bias", "output.correlation"]
    assert [name for name in named if f"`{name}`" not in page] == []
    for bound in (bundle.MAX_BYTES >> 20, container.MAX_HEADER_BYTES >> 20, golden.MAX_CELLS >> 20):
        assert f"{bound} MiB" in page
    assert f"{container.MAX_TENSORS:,};" in page
