"""What makes a training run: the model, the sequences that it learns from, and the recipe."""

import tomllib
from pathlib import Path
from typing import Annotated, Final, Self

from pydantic import BeforeValidator, Field, ValidationError, model_validator

from neurove_core.config import Config, ModelConfig
from neurove_protocol.errors import InvalidField
from neurove_protocol.fields import WrongField

CONFIGS: Final = Path(__file__).parent / "configs"
"""The configurations that come with the package, by name."""

Span = tuple[Annotated[float, Field(ge=0)], Annotated[float, Field(ge=0)]]
"""Least and greatest value that is drawn."""

LogSpan = tuple[Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]]
"""The same, of what is drawn so that its logarithm is uniform."""

Size = Annotated[float, Field(ge=0)]

Shares = dict[str, Size]


class RecordedConfig(Config):
    """A recording with truth, of any format that is read; in a configuration its source alone is enough."""

    source: str = Field(min_length=1, description="A file, a folder that is a recording or holds some, or sim://...")
    height_m: float | None = Field(None, gt=0, le=1000, description="Of its camera; by default what it says itself.")
    topic: str | None = Field(None, description="Which of several event streams.")
    truth: str | None = Field(None, description="A file of the camera's poses; by default the truth that it holds.")


def _named(value: object) -> object:
    return {"source": value} if isinstance(value, str) else value


class DataConfig(Config):
    """What is simulated, and which recordings are learned from beside it or instead.

    Each simulated sequence draws its own scene, way, camera, mount and pixels (domain randomisation). A recording is
    cut into sequences of the same length.
    """

    sequences: int = Field(128, ge=0, le=100_000, description="How many are simulated.")
    recordings: tuple[Annotated[RecordedConfig, BeforeValidator(_named)], ...] = Field(
        (), description="Learned from as well; or alone, with sequences = 0."
    )
    seconds: float = Field(6.0, gt=0, le=600, description="Length of each.")
    seed: int = Field(1_000_000, ge=0, lt=900_000_000, description="Sequence i has the scene and the way of seed + i.")
    motion_px: float = Field(1.5, ge=0.1, le=4, description="Most motion of a pixel between two of its renders.")
    scenes: Shares = Field({"street": 0.6, "corridor": 0.1, "room": 0.3}, description="Share of each scene.")
    hands: Shares = Field(
        {"waved": 0.5, "turned": 0.25, "slid": 0.1, "spun": 0.15},
        description="Share of each way in a room: waved about, turned in place, moved without turning, spun steadily.",
    )
    cameras: Shares = Field(
        {
            "davis346-half": 0.35,
            "davis240c": 0.03,
            "pinhole:172x130": 0.05,
            "pinhole:128x96": 0.35,
            "pinhole:86x65": 0.22,
        },
        description="Share of each camera; small ones are quickly simulated.",
    )
    hfov_deg: Span = Field((55.0, 95.0), description="Field of view of a pinhole that is named without one.")
    height_m: LogSpan = Field((0.3, 2.5), description="Of the camera above the ground, log-uniform.")
    pitch_deg: Span = Field((0.0, 12.0), description="How far the camera looks down, uniform.")
    slowed_drive: LogSpan = Field((1.0, 4.0), description="Log-uniform: how many times slower than a car.")
    slowed_hand: LogSpan = Field(
        (1.0, 6.0), description="Log-uniform: in a room, so many times slower than a wild hand."
    )
    spun_rad_s: LogSpan = Field((0.1, 2.0), description="Log-uniform: rate of a camera that spins in place.")
    spun_axis: tuple[Size, Size, Size] = Field(
        (0.4, 1.0, 0.4), description="Spread of the components x, y and z of its axis before that gets length 1."
    )
    threshold: LogSpan = Field((0.15, 0.4), description="Of ON events, log-uniform; OFF lies within 15 % of it.")
    threshold_sigma: Span = Field((0.02, 0.05), description="Spread of the thresholds between pixels, uniform.")
    refractory_us: Span = Field((100.0, 1000.0), description="Uniform.")
    leak_hz: Span = Field((0.0, 0.2), description="Uniform.")
    shot_noise_hz: LogSpan = Field((0.001, 2.0), description="Log-uniform.")
    cutoff_hz: LogSpan = Field((100.0, 1000.0), description="Log-uniform: how fast pixels are, which light decides.")
    eps: LogSpan = Field((0.001, 0.02), description="Log-uniform: how much of the log intensity the dark hides.")

    @model_validator(mode="after")
    def _something(self) -> Self:
        if not self.sequences and not self.recordings:
            raise ValueError("sequences=0 and no recordings: there is nothing to learn from")
        return self

    @model_validator(mode="after")
    def _spans_and_shares(self) -> Self:
        for name in type(self).model_fields:
            value = getattr(self, name)
            if name not in ("recordings", "spun_axis") and isinstance(value, tuple) and value[0] > value[1]:
                raise ValueError(f"{name}={value}: the least value comes first")
            if isinstance(value, dict) and not sum(value.values()) > 0:
                raise ValueError(f"{name}={value}: some share must be above 0")
        if not sum(self.spun_axis) > 0:
            raise ValueError(f"spun_axis={self.spun_axis}: some spread must be above 0")
        return self


class RecipeConfig(Config):
    """How the network learns; the defaults are recipe L of research/velocity.md."""

    steps: int = Field(4000, ge=1, description="Updates of the weights, in each cycle.")
    cycles: int = Field(1, ge=1, le=100, description="How often the learning rate rises and falls; a run can get more.")
    seed: int = Field(0, ge=0, description="Of the weights, and of what is drawn on the way.")
    batch: int = Field(16, ge=1, le=4096, description="B: streams side by side.")
    segment_windows: int = Field(32, ge=1, description="A stream is followed so long from a state at rest.")
    chunk_windows: int = Field(8, ge=1, description="T: an update and the reach of its gradient, in windows.")
    learning_rate: float = Field(
        1e-3, gt=0, le=1, description="At its peak; it then falls as a cosine to 0. Half of it in the next cycle."
    )
    warm_up_steps: int = Field(100, ge=0, description="Updates until the peak.")
    clip_norm: float = Field(5.0, gt=0, description="Greatest norm of the gradient.")
    norm_momentum: float = Field(0.02, gt=0, le=1, description="How fast tdBN's statistics follow the batches.")
    balance_decay: float = Field(0.99, ge=0, lt=1, description="Of the means that balance L_l and L_a.")
    mirror: float = Field(0.5, ge=0, le=1, description="Share of segments that are seen in a mirror.")
    doubled: float = Field(0.4, ge=0, le=1, description="Share of segments played at twice their speed.")
    reversed: float = Field(0.1, ge=0, le=1, description="Share of segments played backwards.")
    polarity_flip: float = Field(0.5, ge=0, le=1, description="Share of segments whose ON is OFF.")
    noisy: float = Field(0.25, ge=0, le=1, description="Share of segments with random events added.")
    noise_max: float = Field(0.1, ge=0, le=10, description="Most of these, per cell and bin.")
    still: float = Field(0.0, ge=0, le=1, description="Share of segments of a camera at rest, which sees noise alone.")
    still_noise: LogSpan = Field((0.001, 0.5), description="Of these, the mean per cell and bin, log-uniform.")
    regained: float = Field(0.25, ge=0, le=1, description="Share of segments whose counts are scaled.")
    gain: LogSpan = Field(
        (0.5, 4.0), description="By how much, log-uniform: pixels per cell are as many as the sensor has."
    )
    lopsided: float = Field(
        0.0, ge=0, le=1, description="Share of segments with more of one polarity than of the other."
    )
    lopsided_by: LogSpan = Field((0.4, 2.5), description="So many times as many ON as before, over OFF; log-uniform.")
    hot: float = Field(0.0, ge=0, le=1, description="Share of segments with a few hot pixels, which fire all the time.")
    hot_rate: LogSpan = Field((0.1, 20.0), description="Of each of them, events per bin, log-uniform.")
    holes: float = Field(0.0, ge=0, le=1, description="Share of segments in whose feed are holes.")
    hole_windows: LogSpan = Field((1.0, 20.0), description="Of a hole, its length, log-uniform.")
    thinned: float = Field(0.0, ge=0, le=1, description="Share of segments with few events from some window on.")
    thinned_to: LogSpan = Field((0.01, 0.5), description="Share of the events that is left of them, log-uniform.")
    checkpoint_s: float = Field(120.0, ge=0, description="A checkpoint is written so often [s], and at the end.")

    @model_validator(mode="after")
    def _whole_chunks(self) -> Self:
        if self.segment_windows % self.chunk_windows:
            raise ValueError(
                f"segment_windows={self.segment_windows} does not split into chunks of {self.chunk_windows}"
            )
        return self

    @property
    def updates(self) -> int:
        """Updates of all cycles."""
        return self.steps * self.cycles

    @property
    def chunks(self) -> int:
        """Updates per segment."""
        return self.segment_windows // self.chunk_windows

    @property
    def most_windows(self) -> int:
        """Most windows of a sequence that a segment takes."""
        return self.segment_windows * (2 if self.doubled else 1)


class TrainingConfig(Config):
    """A training run; the same configuration gives the same model on one machine and torch version."""

    name: str = Field("model", min_length=1, max_length=64, pattern="^[A-Za-z0-9_][A-Za-z0-9_.-]*$")
    model: ModelConfig = ModelConfig()
    data: DataConfig = DataConfig()
    recipe: RecipeConfig = RecipeConfig()

    @model_validator(mode="after")
    def _segments_fit(self) -> Self:
        windows, takes = self.sequence_windows, self.recipe.most_windows
        if windows < takes:
            raise ValueError(f"a sequence has {windows} windows, a segment takes {takes}")
        return self

    @property
    def sequence_windows(self) -> int:
        """Windows of a simulated sequence, and most of one that a recording is cut into."""
        return int(self.data.seconds * 1e6) // self.model.window.duration_us


def load(source: str) -> TrainingConfig:
    """The configuration of a TOML file, or of one that comes with the package, such as `default`.

    Raises:
        InvalidField: there is no such file, it is no TOML, or a value in it is wrong; the sentence says which.
    """
    path = Path(source)
    if not path.suffix and (CONFIGS / f"{source}.toml").is_file():
        path = CONFIGS / f"{source}.toml"
    try:
        return TrainingConfig.model_validate(tomllib.loads(path.read_text()))
    except OSError as error:
        known = ", ".join(sorted(found.stem for found in CONFIGS.glob("*.toml")))
        why = f"{error.strerror or error}; a TOML file is expected, or one of: {known}"
        raise InvalidField("training", "config", source, why) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InvalidField("training", "config", source, f"not TOML: {error}") from None
    except ValidationError as error:
        wrong = WrongField.of(error)
        raise InvalidField("training", wrong.name or "config", wrong.value, wrong.why) from None
