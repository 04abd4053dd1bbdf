"""Immutable, validated configurations of a model: its windows, its canonical camera and its network.

They are stored in the header of the model's bundle. A wrong value raises an error that names it.
"""

from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    SerializationInfo,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

MAX_CANONICAL_CELLS = 1 << 20
MAX_HISTORY = 16
"""Most earlier windows that `network.history` reaches back."""


class Config(BaseModel):
    """Base of all configurations: immutable, unknown keys are errors, finite numbers only.

    A field in LATER is newer than the stored bundles. It is left out of a dump while it has its default, so that a
    bundle, its digest and a folder of sequences that do not use it stay as they were.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    LATER: ClassVar[tuple[str, ...]] = ()

    @model_serializer(mode="wrap")
    def _without_later(self, dump: SerializerFunctionWrapHandler, _: SerializationInfo) -> dict[str, Any]:
        found: dict[str, Any] = dump(self)
        for name in self.LATER:
            if name in found and getattr(self, name) == type(self).model_fields[name].default:
                del found[name]
        return found


class WindowConfig(Config):
    """How sensor time is split: windows [k * duration_us, (k + 1) * duration_us), each with n equal bins in order."""

    duration_us: int = Field(50_000, gt=0, le=10_000_000, description="Length of one window [us].")
    bins: int = Field(5, ge=1, le=64, description="n: bins per window; they give 2n input channels.")
    max_hole_windows: int = Field(
        20, ge=1, le=10_000, description="A longer gap in sensor time, in windows, is skipped instead of computed."
    )

    @model_validator(mode="after")
    def _bins_fill_the_window(self) -> Self:
        if self.duration_us % self.bins:
            raise ValueError(f"duration_us={self.duration_us} does not split into {self.bins} equal bins")
        return self

    @property
    def bin_us(self) -> int:
        """Length of one bin [us]."""
        return self.duration_us // self.bins


class CanonicalConfig(Config):
    """The pinhole camera that the network sees for any sensor; its grid is also the spatial down-sampling."""

    width: int = Field(86, ge=8, description="Grid columns.")
    height: int = Field(65, ge=8, description="Grid rows.")
    hfov_deg: float = Field(75.0, gt=1, lt=170, description="Horizontal field of view [deg]; cells are square.")
    subcells: Literal[1, 2] = Field(
        1,
        description="Parts of a cell in each direction: 2 counts the four quarters of a cell in channels of their own.",
    )

    LATER = ("subcells",)

    @model_validator(mode="after")
    def _bounded(self) -> Self:
        cells = self.width * self.height * self.parts
        if cells > MAX_CANONICAL_CELLS:
            raise ValueError(f"width * height * subcells**2 = {cells}: at most {MAX_CANONICAL_CELLS} cells")
        return self

    @property
    def fine(self) -> "CanonicalConfig":
        """The grid whose cells are the parts of this one."""
        size = {"width": self.width * self.subcells, "height": self.height * self.subcells}
        return CanonicalConfig.model_validate(self.model_dump() | size | {"subcells": 1})

    @property
    def parts(self) -> int:
        """Parts of a cell that are counted apart: the square of `subcells`."""
        return self.subcells**2


class NetworkConfig(Config):
    """The network of paper section III: spiking feature extractor and velocity estimator."""

    encoding: Literal["binary", "log1p"] = Field("log1p", description="Counts to input: 0/1, or log(1 + count).")
    precision: Literal["float32", "int8"] = Field(
        "float32",
        description="Precision of extractor and projection; int8 rounds their weights to 8 bits, the input to 1/32.",
    )
    channels: Annotated[tuple[int, ...], Field(min_length=1, max_length=8)] = (16, 32, 64, 64)
    features: int = Field(128, ge=1, le=4096, description="Width of the layer between extractor and estimator.")
    hidden: int = Field(128, ge=1, le=4096, description="Units of each ASLSTM cell.")
    cells: int = Field(2, ge=1, le=8, description="ASLSTM layers; the paper has two.")
    history: Annotated[tuple[int, ...], Field(max_length=4)] = Field(
        (), description="Longer time: number of earlier windows in each further bin, the newest first, such as 1, 2, 4."
    )
    decay: float = Field(0.5, ge=0, lt=1, description="LIF leak per time step: 1 - dt/tau.")
    v_th: float = Field(1.0, gt=0, description="Firing threshold of all neurons.")
    alpha: float = Field(0.9, ge=0, le=1, description="ASLSTM: share of h in the membrane potential.")
    diffusion: bool = Field(True, description="Astrocyte diffusion J; false gives the paper's variant w/o.")
    surrogate: Literal["rectangular", "arctan", "triangle"] = "rectangular"
    surrogate_width: float = Field(1.0, gt=0, description="Width of the surrogate gradient, in thresholds.")

    LATER = ("history",)

    @model_validator(mode="after")
    def _channels_positive(self) -> Self:
        if not all(1 <= count <= 1024 for count in self.channels):
            raise ValueError(f"channels={self.channels}: each must be 1 to 1024")
        return self

    @model_validator(mode="after")
    def _history_bounded(self) -> Self:
        if not all(1 <= count <= MAX_HISTORY for count in self.history) or sum(self.history) > MAX_HISTORY:
            raise ValueError(f"history={self.history}: each must be at least 1, and all at most {MAX_HISTORY} windows")
        return self


class ModelConfig(Config):
    """All settings of a model and its input."""

    kind: Literal["neurove", "ann", "snn-ang"] = Field(
        "neurove",
        description="Which network: NeuroVE, the equal-size network without spikes, or SNN-ANG; see networks.",
    )
    window: WindowConfig = WindowConfig()
    canonical: CanonicalConfig = CanonicalConfig()
    network: NetworkConfig = NetworkConfig()
    settle_windows: int = Field(16, ge=0, le=256, description="Windows until a new state is settled.")
    low_activity_events: int = Field(200, ge=0, description="A window with fewer events is flagged low_activity.")
    low_activity_per_pixel: float = Field(
        0.05,
        ge=0,
        le=100,
        description="The same for events per pixel that the model sees; a stationary sensor has 0.02 to 0.12.",
    )

    scales: Annotated[tuple[int, ...], Field(max_length=4)] = Field(
        (), description="Longer windows that the network runs on too, in windows, such as 2, 4, 8; see timescales."
    )
    scale_bounds: tuple[float, float] = Field(
        (4.0, 0.5),
        description="Greatest linear (model's unit) and angular [rad/s] speed, times the scale, of a longer window.",
    )
    scale_floor: float = Field(
        0.25,
        ge=0,
        description="Linear speed (model's unit) of one window below which no longer window answers; see timescales.",
    )

    LATER = ("scales", "scale_bounds", "scale_floor")

    @model_validator(mode="after")
    def _scales_rise(self) -> Self:
        if list(self.scales) != sorted(set(self.scales)) or not all(2 <= one <= MAX_HISTORY for one in self.scales):
            raise ValueError(f"scales={self.scales}: must rise, from at least 2 to at most {MAX_HISTORY}")
        if not min(self.scale_bounds) > 0:
            raise ValueError(f"scale_bounds={self.scale_bounds}: both must be above 0")
        if self.scales and self.network.history:
            raise ValueError(f"scales={self.scales}: a model with network.history={self.network.history} has none")
        return self

    @property
    def window_shape(self) -> tuple[int, int, int]:
        """Shape (C, H, W) of a window's counts; C = 2n * parts, see `ingest.windows.Window`."""
        return 2 * self.window.bins * self.canonical.parts, self.canonical.height, self.canonical.width

    @property
    def input_shape(self) -> tuple[int, int, int]:
        """Shape (C, H, W) of the network's input: a window's channels, then those of the history."""
        channels, rows, columns = self.window_shape
        return channels + 2 * self.canonical.parts * len(self.network.history), rows, columns

    @model_validator(mode="after")
    def _int8_is_neuroves(self) -> Self:
        if self.kind != "neurove" and self.network.precision != "float32":
            raise ValueError(f"network.precision={self.network.precision!r}: kind={self.kind!r} supports float32 only")
        return self
