"""Optional header fields of a bundle: release, provenance, measured figures, priming and trial limits.

Every field may be missing. Older bundles without these fields load as before.
"""

from typing import Annotated, Final, Literal

from pydantic import Field, JsonValue

from neurove_core.config import Config

MAX_RELEASE: Final = (1 << 63) - 1


Record = dict[str, JsonValue]
"""Settings as JSON. Pydantic bounds the depth, and all numbers are finite."""

FigureName = Annotated[str, Field(pattern="^[A-Za-z0-9_.]{1,64}$")]


class MadeBy(Config):
    """Provenance as fields: enough to train the model again."""

    program: str = Field(max_length=200, description="Command that made the model, such as `neurove train default`.")
    seed: int = Field(ge=0, description="Seed of the weights and of all random choices in training.")
    commit: str | None = Field(
        None, max_length=100, description="Commit of the source code, if it was a git work tree."
    )
    torch: str | None = Field(None, max_length=100, description="Version of torch.")
    updates: int = Field(0, ge=0, description="Number of weight updates.")
    cpu_s: float = Field(0.0, ge=0, description="CPU time of training [s].")
    recipe: Record = Field(default_factory=dict, description="Training settings.")
    data: Record = Field(default_factory=dict, description="Training data.")


class BundleLimits(Config):
    """Largest allowed differences from the model it replaces on the same windows; None: no limit."""

    mean_dv_m_s: float | None = Field(None, gt=0, description="Mean length of the linear difference [m/s].")
    mean_dw_rad_s: float | None = Field(None, gt=0, description="Mean length of the angular difference [rad/s].")
    latency_ratio: float | None = Field(None, gt=0, description="Time per window, as a multiple of the other's.")


class Metadata(Config):
    """The optional header fields of a bundle."""

    release: int = Field(0, ge=0, le=MAX_RELEASE, description="Counter: a node does not accept a lower release.")
    figures: dict[FigureName, float] = Field(
        {}, max_length=64, description="Measured figures; each name ends in its unit."
    )
    made_by: MadeBy | None = None
    prime_windows: int | None = Field(
        None, ge=0, le=256, description="Windows that a stream replays to settle; None: settle_windows."
    )
    limits: BundleLimits | None = None
    refine: Literal["auto", "off"] = Field(
        "auto", description="Whether a node may refine the angular velocity of this model's estimates."
    )

    def non_default_fields(self) -> set[str]:
        """Names of the fields whose values are not the defaults."""
        fields = Metadata.model_fields
        return {name for name in fields if getattr(self, name) != fields[name].default}
