"""What a bundle tells beyond what it needs to run: its release, how it was made, what it reached, how to take over.

All of it may be missing: bundles made before it was written down load as they did.
"""

from typing import Annotated, Final

from pydantic import Field, JsonValue

from neurove_core.config import Config

MAX_RELEASE: Final = (1 << 63) - 1


Record = dict[str, JsonValue]
"""Settings as JSON; their depth is bounded by pydantic, their numbers are finite."""

FigureName = Annotated[str, Field(pattern="^[A-Za-z0-9_.]{1,64}$")]


class MadeBy(Config):
    """Provenance as fields: enough to make the model anew."""

    program: str = Field(max_length=200, description="What was run, such as `neurove train default`.")
    seed: int = Field(ge=0, description="Of the weights, and of what was drawn on the way.")
    commit: str | None = Field(None, max_length=100, description="Of the source that ran, where it was a work tree.")
    torch: str | None = Field(None, max_length=100, description="Version of torch.")
    updates: int = Field(0, ge=0, description="Updates of the weights.")
    cpu_s: float = Field(0.0, ge=0, description="CPU time of learning [s].")
    recipe: Record = Field(default_factory=dict, description="How it learned.")
    data: Record = Field(default_factory=dict, description="What it learned from.")


class BundleLimits(Config):
    """By how much a model may differ from the one before while both see the same windows; none: that is not judged."""

    mean_dv_m_s: float | None = Field(None, gt=0, description="Mean length of the linear difference [m/s].")
    mean_dw_rad_s: float | None = Field(None, gt=0, description="Mean length of the angular difference [rad/s].")
    latency_ratio: float | None = Field(None, gt=0, description="Time of a window, as a multiple of the other's.")


class Metadata(Config):
    """The optional fields of a bundle's header."""

    release: int = Field(0, ge=0, le=MAX_RELEASE, description="Counter: a node does not go back to a lower one.")
    figures: dict[FigureName, float] = Field({}, max_length=64, description="What was measured; names have the unit.")
    made_by: MadeBy | None = None
    prime_windows: int | None = Field(
        None, ge=0, le=256, description="Windows that a stream replays until it is settled; none: settle_windows."
    )
    limits: BundleLimits | None = None

    def non_default_fields(self) -> set[str]:
        """The fields that say something: those that are not at their defaults."""
        fields = Metadata.model_fields
        return {name for name in fields if getattr(self, name) != fields[name].default}
