"""Configuration of a training run: the model, the training sequences, and the recipe."""

from pathlib import Path
from typing import Annotated, Final, Literal, Self

from pydantic import BeforeValidator, Field, ValidationError, model_validator

from neurove_core.config import Config, ModelConfig
from neurove_core.files import read_toml
from neurove_protocol.errors import InvalidField
from neurove_protocol.fields import WrongField

CONFIGS: Final = Path(__file__).parent / "configs"
"""Folder of the built-in configurations."""

Span = tuple[Annotated[float, Field(ge=0)], Annotated[float, Field(ge=0)]]
"""Range (low, high) of a uniform draw."""

LogSpan = tuple[Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]]
"""Range (low, high) of a log-uniform draw."""

Size = Annotated[float, Field(ge=0)]

Shares = dict[str, Size]


class RecordedConfig(Config):
    """A recording with ground truth, in any supported format. A configuration may give only its source, as a string."""

    source: str = Field(min_length=1, description="File, folder (one recording or several), or sim://...")
    height_m: float | None = Field(
        None, gt=0, le=1000, description="Height of the camera [m]; by default that of the recording."
    )
    topic: str | None = Field(None, description="Event stream, if the recording has several.")
    time_unit: Literal["s", "ms", "us", "ns"] | None = Field(
        None, description="Unit of the event times in the file; by default that of its layout."
    )
    truth: str | None = Field(None, description="File with poses of the camera; by default the truth in the recording.")


def _from_source(value: object) -> object:
    return {"source": value} if isinstance(value, str) else value


SINCE: Final = ("spun_axis", "robots", "robot_m_s", "robot_rad_s", "rocked", "rocked_rad_s", "subcells", "off_ratio")
"""Fields of DataConfig that are newer than the stored sequences; sequences stay valid where they have their default."""


class DataConfig(Config):
    """Simulated sequences and recordings of a training run.

    Each simulated sequence draws its own scene, trajectory, camera, mount and pixels (domain randomisation). A
    recording is split into sequences of the same length. Bundles and checkpoints store the names of these fields.
    """

    sequences: int = Field(128, ge=0, le=100_000, description="Number of simulated sequences.")
    recordings: tuple[Annotated[RecordedConfig, BeforeValidator(_from_source)], ...] = Field(
        (), description="Recordings to train on, in addition or alone (sequences = 0)."
    )
    seconds: float = Field(6.0, gt=0, le=600, description="Length of each sequence [s].")
    seed: int = Field(
        1_000_000, ge=0, lt=900_000_000, description="Sequence i has the scene and trajectory of seed + i."
    )
    motion_px: float = Field(1.5, ge=0.1, le=4, description="Greatest motion between two renders of a pixel [px].")
    scenes: Shares = Field({"street": 0.6, "corridor": 0.1, "room": 0.3}, description="Share of each scene.")
    hands: Shares = Field(
        {"waved": 0.5, "turned": 0.25, "slid": 0.1, "spun": 0.15},
        description="Share of each motion in a room: waved, turned in place, moved without turning, spun steadily.",
    )
    cameras: Shares = Field(
        {
            "davis346-half": 0.35,
            "davis240c": 0.03,
            "pinhole:172x130": 0.05,
            "pinhole:128x96": 0.35,
            "pinhole:86x65": 0.22,
        },
        description="Share of each camera; small sensors simulate faster.",
    )
    hfov_deg: Span = Field((55.0, 95.0), description="Field of view of a pinhole without one in its name [deg].")
    height_m: LogSpan = Field((0.3, 2.5), description="Height of the camera above the ground, log-uniform [m].")
    pitch_deg: Span = Field((0.0, 12.0), description="Pitch of the camera, down, uniform [deg].")
    slowed_drive: LogSpan = Field((1.0, 4.0), description="How many times slower than a car, log-uniform.")
    slowed_hand: LogSpan = Field(
        (1.0, 6.0), description="In a room: how many times slower than the hand-held trajectory, log-uniform."
    )
    spun_rad_s: LogSpan = Field((0.1, 2.0), description="Rate of a camera that spins in place, log-uniform.")
    spun_axis: tuple[Size, Size, Size] = Field(
        (0.4, 1.0, 0.4), description="Standard deviation of x, y, z of its axis before normalisation."
    )
    robots: float = Field(0.0, ge=0, le=1, description="Share of the drives that are of a small robot, not of a car.")
    robot_m_s: LogSpan = Field((0.1, 3.0), description="Forward speed of a robot while it moves, log-uniform [m/s].")
    robot_rad_s: LogSpan = Field((0.05, 1.2), description="Rate of a robot that turns, log-uniform [rad/s].")
    rocked: float = Field(0.0, ge=0, le=1, description="Share of the drives with a rocking camera.")
    rocked_rad_s: LogSpan = Field(
        (0.01, 0.1), description="Root mean square of the pitch rate that rocking adds, log-uniform [rad/s]."
    )
    subcells: Literal[1, 2] = Field(
        1,
        description="Cells of the stored counts per canonical cell and axis; 2 serves models of any subcells.",
    )
    threshold: LogSpan = Field((0.15, 0.4), description="Threshold of ON events, log-uniform.")
    off_ratio: Span = Field((0.85, 1.15), description="Threshold of OFF events over that of ON events, uniform.")
    threshold_sigma: Span = Field(
        (0.02, 0.05), description="Standard deviation of the thresholds between pixels, uniform."
    )
    refractory_us: Span = Field((100.0, 1000.0), description="Refractory time of a pixel, uniform [us].")
    leak_hz: Span = Field((0.0, 0.2), description="Rate of leak events of a pixel, uniform [Hz].")
    shot_noise_hz: LogSpan = Field((0.001, 2.0), description="Rate of shot noise of a pixel, log-uniform [Hz].")
    cutoff_hz: LogSpan = Field((100.0, 1000.0), description="Bandwidth of the pixels, log-uniform [Hz].")
    eps: LogSpan = Field((0.001, 0.02), description="Offset in log(I + eps), log-uniform; it hides dark contrasts.")

    @model_validator(mode="after")
    def _has_sequences(self) -> Self:
        if not self.sequences and not self.recordings:
            raise ValueError("sequences=0 and no recordings: there is nothing to train on")
        return self

    @model_validator(mode="after")
    def _spans_and_shares(self) -> Self:
        for name in type(self).model_fields:
            value = getattr(self, name)
            if name not in ("recordings", "spun_axis") and isinstance(value, tuple) and value[0] > value[1]:
                raise ValueError(f"{name}={value}: the lower value must come first")
            if isinstance(value, dict) and not sum(value.values()) > 0:
                raise ValueError(f"{name}={value}: at least one share must be above 0")
        if not sum(self.spun_axis) > 0:
            raise ValueError(f"spun_axis={self.spun_axis}: at least one component must be above 0")
        return self


class RecipeConfig(Config):
    """Optimisation and augmentation; the defaults are recipe L of research/velocity.md.

    The names of these fields are stored in bundles and checkpoints, so they keep their older words: `still` is a
    stationary camera, `holes` are gaps in the events, `regained` counts are multiplied by a gain.
    """

    steps: int = Field(4000, ge=1, description="Updates of the weights per cycle.")
    cycles: int = Field(
        1, ge=1, le=100, description="Cycles of the learning rate; a finished run can continue with more."
    )
    seed: int = Field(0, ge=0, description="Seed of the weights and of all random draws.")
    batch: int = Field(16, ge=1, le=4096, description="B: streams in parallel.")
    segment_windows: int = Field(32, ge=1, description="Windows of a segment; it starts from the zero state.")
    chunk_windows: int = Field(8, ge=1, description="T: windows per update; its gradient reaches as far.")
    learning_rate: float = Field(
        1e-3, gt=0, le=1, description="Peak; then a cosine to 0. Each further cycle has half the peak."
    )
    warm_up_steps: int = Field(100, ge=0, description="Updates before the peak.")
    clip_norm: float = Field(5.0, gt=0, description="Greatest norm of the gradient.")
    norm_momentum: float = Field(0.02, gt=0, le=1, description="Momentum of the statistics of tdBN.")
    balance_decay: float = Field(0.99, ge=0, lt=1, description="Decay of the means that balance L_l and L_a.")
    mirror: float = Field(0.5, ge=0, le=1, description="Share of segments that are mirrored.")
    doubled: float = Field(0.4, ge=0, le=1, description="Share of segments at twice their speed.")
    reversed: float = Field(0.1, ge=0, le=1, description="Share of segments in reversed time.")
    polarity_flip: float = Field(0.5, ge=0, le=1, description="Share of segments with ON and OFF swapped.")
    noisy: float = Field(0.25, ge=0, le=1, description="Share of segments with random events added.")
    noise_max: float = Field(0.1, ge=0, le=10, description="Greatest mean number of random events per cell and bin.")
    still: float = Field(0.0, ge=0, le=1, description="Share of segments of a stationary camera: noise only.")
    still_noise: LogSpan = Field((0.001, 0.5), description="Their mean events per cell and bin, log-uniform.")
    regained: float = Field(0.25, ge=0, le=1, description="Share of segments with counts times a gain.")
    gain: LogSpan = Field(
        (0.5, 4.0), description="That gain, log-uniform; it stands for the number of pixels per cell."
    )
    lopsided: float = Field(0.0, ge=0, le=1, description="Share of segments with a changed ratio of ON to OFF.")
    lopsided_by: LogSpan = Field((0.4, 2.5), description="Factor of that ratio, log-uniform.")
    hot: float = Field(0.0, ge=0, le=1, description="Share of segments with a few hot pixels.")
    hot_rate: LogSpan = Field((0.1, 20.0), description="Events per bin of a hot pixel, log-uniform.")
    holes: float = Field(0.0, ge=0, le=1, description="Share of segments with gaps in the events.")
    hole_windows: LogSpan = Field((1.0, 20.0), description="Length of a gap in windows, log-uniform.")
    thinned: float = Field(0.0, ge=0, le=1, description="Share of segments with few events from a random window on.")
    thinned_to: LogSpan = Field((0.01, 0.5), description="Share of the events that remain, log-uniform.")
    validation_share: float = Field(
        0.15, ge=0, le=0.5, description="Share of each recording, its end, that validates the run; 0: none."
    )
    validation_sequences: int = Field(
        8, ge=0, le=1000, description="Simulated sequences of one segment that validate the run; 0: none."
    )
    patience: float = Field(
        0.3, gt=0, le=1, description="Share of the updates without improvement that ends a run early; 1: never."
    )
    checkpoint_s: float = Field(120.0, ge=0, description="Interval of checkpoints [s]; one is also written at the end.")

    @model_validator(mode="after")
    def _whole_chunks(self) -> Self:
        if self.segment_windows % self.chunk_windows:
            raise ValueError(
                f"segment_windows={self.segment_windows} does not split into chunks of {self.chunk_windows}"
            )
        return self

    @property
    def updates(self) -> int:
        """Number of updates in all cycles."""
        return self.steps * self.cycles

    @property
    def chunks(self) -> int:
        """Number of updates per segment."""
        return self.segment_windows // self.chunk_windows

    @property
    def most_windows(self) -> int:
        """Greatest number of windows of a sequence that a segment needs."""
        return self.segment_windows * (2 if self.doubled else 1)


class TrainingConfig(Config):
    """A training run; the same configuration gives the same model on one machine and torch version."""

    name: str = Field("model", min_length=1, max_length=64, pattern="^[A-Za-z0-9_][A-Za-z0-9_.-]*$")
    model: ModelConfig = ModelConfig()
    data: DataConfig = DataConfig()
    recipe: RecipeConfig = RecipeConfig()

    @model_validator(mode="after")
    def _segments_fit(self) -> Self:
        windows, needed = self.sequence_windows, self.recipe.most_windows
        if windows < needed:
            twice = " at twice the speed (recipe.doubled)" if self.recipe.doubled else ""
            have = f"data.seconds={self.data.seconds:g} has {windows} windows of {self.model.window.duration_us} us"
            wants = f"recipe.segment_windows={self.recipe.segment_windows} needs {needed}{twice}"
            raise ValueError(f"a sequence of {have}, a segment of {wants}")
        return self

    @model_validator(mode="after")
    def _subcells_are_stored(self) -> Self:
        if self.data.subcells < self.model.canonical.subcells:
            wanted = f"model.canonical.subcells={self.model.canonical.subcells} needs as many"
            raise ValueError(f"data.subcells={self.data.subcells}: {wanted}")
        return self

    @property
    def sequence_windows(self) -> int:
        """Windows of a simulated sequence, and the most windows of a sequence of a recording."""
        return int(self.data.seconds * 1e6) // self.model.window.duration_us


def load(source: str) -> TrainingConfig:
    """Load a configuration from a TOML file, or a built-in one by its name, such as `default`.

    Raises:
        InvalidField: the file does not exist or is not TOML, or a value is wrong; the error names the field.
    """
    path = Path(source)
    if not path.suffix and (CONFIGS / f"{source}.toml").is_file():
        path = CONFIGS / f"{source}.toml"
    try:
        return TrainingConfig.model_validate(read_toml(path))
    except OSError as error:
        known = ", ".join(sorted(found.stem for found in CONFIGS.glob("*.toml")))
        why = f"{error.strerror or error}; expected a TOML file or one of: {known}"
        raise InvalidField("training", "config", source, why) from None
    except ValidationError as error:  # before ValueError, which it is
        wrong = WrongField.of(error)
        raise InvalidField("training", wrong.name or "config", wrong.value, wrong.why) from None
    except ValueError as error:
        raise InvalidField("training", "config", source, f"not TOML: {error}") from None
