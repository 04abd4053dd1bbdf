"""Configurations: a wrong value is named with its bound, and every accepted value gives a model that runs."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from neurove_core.config import MAX_CANONICAL_CELLS, CanonicalConfig, Config, ModelConfig, NetworkConfig, WindowConfig
from neurove_core.estimator import Estimator
from neurove_core.models import bundle

WRONG = [
    (WindowConfig, "duration_us", 0, "greater than 0"),
    (WindowConfig, "duration_us", -1, "greater than 0"),
    (WindowConfig, "duration_us", 10_000_001, "less than or equal to 10000000"),
    (WindowConfig, "duration_us", 0.5, "valid integer"),
    (WindowConfig, "bins", 0, "greater than or equal to 1"),
    (WindowConfig, "bins", 65, "less than or equal to 64"),
    (WindowConfig, "max_hole_windows", 0, "greater than or equal to 1"),
    (WindowConfig, "max_hole_windows", 10_001, "less than or equal to 10000"),
    (CanonicalConfig, "width", 7, "greater than or equal to 8"),
    (CanonicalConfig, "height", 7, "greater than or equal to 8"),
    (CanonicalConfig, "hfov_deg", 1.0, "greater than 1"),
    (CanonicalConfig, "hfov_deg", 170.0, "less than 170"),
    (CanonicalConfig, "hfov_deg", float("nan"), "finite number"),
    (CanonicalConfig, "subcells", 3, "1 or 2"),
    (NetworkConfig, "history", (0,), "each must be at least 1"),
    (NetworkConfig, "history", (9, 8), "at most 16 windows"),
    (ModelConfig, "scales", (1,), "from at least 2 to at most 16"),
    (ModelConfig, "scales", (4, 2), "must rise"),
    (ModelConfig, "scale_bounds", (0.0, 1.0), "both must be above 0"),
    (ModelConfig, "scale_floor", -0.1, "greater than or equal to 0"),
    (NetworkConfig, "encoding", "rate", "'binary' or 'log1p'"),
    (NetworkConfig, "precision", "int4", "'float32' or 'int8'"),
    (NetworkConfig, "channels", (), "at least 1 item"),
    (NetworkConfig, "channels", (1,) * 9, "at most 8 items"),
    (NetworkConfig, "channels", (16, 0), "each must be 1 to 1024"),
    (NetworkConfig, "channels", (1025,), "each must be 1 to 1024"),
    (NetworkConfig, "features", 0, "greater than or equal to 1"),
    (NetworkConfig, "features", 4097, "less than or equal to 4096"),
    (NetworkConfig, "hidden", 0, "greater than or equal to 1"),
    (NetworkConfig, "hidden", 4097, "less than or equal to 4096"),
    (NetworkConfig, "cells", 0, "greater than or equal to 1"),
    (NetworkConfig, "cells", 9, "less than or equal to 8"),
    (NetworkConfig, "decay", -0.1, "greater than or equal to 0"),
    (NetworkConfig, "decay", 1.0, "less than 1"),
    (NetworkConfig, "v_th", 0.0, "greater than 0"),
    (NetworkConfig, "v_th", float("inf"), "finite number"),
    (NetworkConfig, "alpha", -0.1, "greater than or equal to 0"),
    (NetworkConfig, "alpha", 1.1, "less than or equal to 1"),
    (NetworkConfig, "diffusion", "perhaps", "valid boolean"),
    (NetworkConfig, "surrogate", "sigmoid", "'rectangular', 'arctan' or 'triangle'"),
    (NetworkConfig, "surrogate_width", 0.0, "greater than 0"),
    (ModelConfig, "kind", "lstm", "'neurove', 'ann' or 'snn-ang'"),
    (ModelConfig, "settle_windows", -1, "greater than or equal to 0"),
    (ModelConfig, "settle_windows", 257, "less than or equal to 256"),
    (ModelConfig, "low_activity_events", -1, "greater than or equal to 0"),
    (ModelConfig, "low_activity_per_pixel", -1, "greater than or equal to 0"),
]


@pytest.mark.parametrize(("model", "field", "value", "bound"), WRONG)
def test_a_wrong_value_is_rejected_with_field_value_and_bound(model, field, value, bound):
    with pytest.raises(ValidationError) as refused:
        model(**{field: value})
    message = str(refused.value)
    assert field in message
    assert str(value) in message
    assert bound in message


def test_every_setting_with_a_bound_is_tested_with_a_wrong_value():
    tried = {(model, field) for model, field, _, _ in WRONG}
    parts = {(ModelConfig, name) for name in ("window", "canonical", "network")}
    models: tuple[type[Config], ...] = (WindowConfig, CanonicalConfig, NetworkConfig, ModelConfig)
    assert tried == {(model, field) for model in models for field in model.model_fields} - parts


@pytest.mark.parametrize("model", [WindowConfig, CanonicalConfig, NetworkConfig, ModelConfig])
def test_an_unknown_key_is_rejected_by_name(model):
    with pytest.raises(ValidationError, match=r"durations_ms\n.*not permitted"):
        model(durations_ms=5)


@pytest.mark.parametrize("model", [WindowConfig, CanonicalConfig, NetworkConfig, ModelConfig])
def test_a_configuration_is_immutable(model):
    name = next(iter(model.model_fields))
    config = model()
    with pytest.raises(ValidationError, match="frozen"):
        setattr(config, name, getattr(config, name))


@given(duration_us=st.integers(1, 10_000_000), bins=st.integers(1, 64))
def test_bins_that_do_not_fill_the_window_are_rejected_with_both_numbers(duration_us, bins):
    if duration_us % bins == 0:
        assert WindowConfig(duration_us=duration_us, bins=bins).bin_us * bins == duration_us
    else:
        with pytest.raises(ValidationError, match=f"duration_us={duration_us} does not split into {bins} equal bins"):
            WindowConfig(duration_us=duration_us, bins=bins)


def test_a_canonical_camera_has_at_most_the_maximum_number_of_cells():
    side = int(MAX_CANONICAL_CELLS**0.5)
    assert CanonicalConfig(width=side, height=side).width == side
    with pytest.raises(ValidationError, match=rf"{side * (side + 1)}: at most {MAX_CANONICAL_CELLS} cells"):
        CanonicalConfig(width=side, height=side + 1)


small: dict[str, st.SearchStrategy[Any]] = {
    "window": st.builds(lambda n, b: WindowConfig(duration_us=n * b, bins=b), st.integers(1, 4_000), st.integers(1, 6)),
    "canonical": st.builds(
        CanonicalConfig,
        width=st.integers(8, 20),
        height=st.integers(8, 20),
        hfov_deg=st.floats(2, 169),
        subcells=st.sampled_from([1, 2]),
    ),
    "network": st.builds(
        NetworkConfig,
        encoding=st.sampled_from(["binary", "log1p"]),
        channels=st.lists(st.integers(1, 4), min_size=1, max_size=8).map(tuple),
        features=st.integers(1, 6),
        hidden=st.integers(1, 6),
        cells=st.integers(1, 3),
        decay=st.floats(0, 0.99),
        v_th=st.floats(1e-3, 10),
        alpha=st.floats(0, 1),
        history=st.sampled_from([(), (1,), (1, 2, 4)]),
        diffusion=st.booleans(),
        surrogate=st.sampled_from(["rectangular", "arctan", "triangle"]),
    ),
    "settle_windows": st.integers(0, 5),
}


@given(st.fixed_dictionaries(small))
def test_every_accepted_configuration_gives_a_model_that_warms_up_and_survives_save_and_load(parts):
    config = ModelConfig(**parts)
    assert ModelConfig.model_validate_json(config.model_dump_json()) == config
    model = bundle.untrained(0, config)
    Estimator(model).warm_up()
    assert bundle.from_bytes(model.to_bytes(), "x").config == config
