"""Configuration of the service and its clients: defaults < TOML file < environment NEUROVE_* < flags.

An unknown key or a wrong value stops the start with one sentence that names the field, the value, the bound and the
source of the value.
"""

import logging
import os
import re
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_settings import (
    BaseSettings,
    EnvSettingsSource,
    NoDecode,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
)

from neurove_core.files import read_toml
from neurove_protocol.errors import NeuroVEError
from neurove_protocol.events import MAX_PACKET_BYTES, PacketLimits
from neurove_protocol.fields import WrongField
from neurove_protocol.keys import DEFAULT_PREFIX, Keys, check_name
from neurove_service.endpoints import check_address, check_endpoint
from neurove_service.labels import check_labels

log = logging.getLogger(__name__)

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
ENVIRONMENT = "NEUROVE_"


class ConfigError(NeuroVEError):
    """A setting is unknown or wrong."""

    code = "config"


def _listed(value: object) -> object:
    return [part.strip() for part in value.split(",") if part.strip()] if isinstance(value, str) else value


def _pairs(value: object) -> object:
    """A table from the text of a flag or a variable: `site=hall-2,robot=spot`."""
    if not isinstance(value, str):
        return value
    parts = [part.strip().partition("=") for part in value.split(",") if part.strip()]
    for name, equals, _ in parts:
        if not equals:
            raise ValueError(f"{name!r} has no value: give NAME=VALUE,NAME=VALUE")
    if len({name.strip() for name, _, _ in parts}) < len(parts):
        raise ValueError("a name occurs twice")
    return {name.strip(): text.strip() for name, _, text in parts}


def _given(value: object) -> object:
    """A path, or several, that is not empty: an empty one would be the current folder."""
    if isinstance(value, str) and not value.strip():
        raise ValueError("must not be empty; the current folder is '.'")
    return value


def _standby(value: object) -> object:
    """The setting as text; TOML and the environment may also say true or false."""
    text = str(value).lower()
    return {"true": "last", "false": "off"}.get(text, value)


Endpoints = Annotated[tuple[Annotated[str, AfterValidator(check_endpoint)], ...], NoDecode, BeforeValidator(_listed)]
Pattern = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.*-]{1,64}$")]
GivenPath = Annotated[Path, BeforeValidator(_given)]
Names = Annotated[
    tuple[Annotated[str, AfterValidator(lambda name: check_name("expect_streams", name))], ...],
    NoDecode,
    BeforeValidator(_listed),
]
Paths = Annotated[tuple[GivenPath, ...], NoDecode, BeforeValidator(lambda value: _listed(_given(value)))]

_OF_KUBERNETES = re.compile(
    r"(\w+_)?(SERVICE_HOST|SERVICE_PORT(_\w+)?|PORT(_\d+_(TCP|UDP|SCTP)(_(PROTO|PORT|ADDR))?)?)"
)
"""What follows NEUROVE_ in the variables that Kubernetes sets in every pod for a service whose name begins so."""
_OF_ENGINE = ("form", "ahead")
"""The same of variables that neurove_core reads: engine/choice.py and compiled/ahead.py."""


class _Settings(BaseSettings):
    model_config = SettingsConfigDict(env_prefix=ENVIRONMENT, frozen=True, extra="forbid", allow_inf_nan=False)

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Only the values from load(), which reads the sources itself to know the source of each value."""
        return (init_settings,)

    prefix: Annotated[str, BeforeValidator(lambda value: Keys(str(value)).prefix)] = Field(
        DEFAULT_PREFIX, description="Key prefix of the deployment."
    )
    log_level: Literal["debug", "info", "warning", "error"] = Field("info", description="Least severe line logged.")
    zenoh_config: GivenPath | None = Field(
        None, description="Zenoh configuration (JSON5) with further settings, such as TLS."
    )

    @property
    def keys(self) -> Keys:
        """The keys under the configured prefix."""
        return Keys(self.prefix)


class ClientConfig(_Settings):
    """Settings of drive, watch, health and the other commands that connect to a service."""

    connect: Endpoints = Field((DEFAULT_ENDPOINT,), min_length=1, description="Endpoints to connect to.")


class ServiceConfig(_Settings):
    """Settings of `neurove serve`."""

    node: Annotated[str, BeforeValidator(lambda value: check_name("node", str(value)))] = Field(
        "edge", description="Name of this node: one key chunk."
    )
    labels: Annotated[dict[str, str], NoDecode, BeforeValidator(_pairs), AfterValidator(check_labels)] = Field(
        {},
        description="Labels of this node for `neurove fleet` and `neurove rollout`, such as site=hall-2,robot=spot.",
    )
    mode: Literal["peer", "client", "router"] = Field(
        "peer", description="Zenoh mode: peer for direct links, client with a router."
    )
    listen: Endpoints = Field((DEFAULT_ENDPOINT,), description="Endpoints to listen on; none in client mode.")
    connect: Endpoints = Field(
        (), validate_default=True, description="Endpoints to connect to, such as the one of a router."
    )
    model: str = Field("default", min_length=1, description="Active model at the start: its name, or a bundle file.")
    models_dir: GivenPath | None = Field(None, description="Folder of bundles that may be activated.")
    state_dir: GivenPath | None = Field(
        None, description="Folder of pushed models and of the state that survives a restart; default: models_dir."
    )
    trusted_keys: Paths = Field(
        (),
        description="Public keys (PEM): only models signed by one of them are accepted and activated; none: any model.",
    )
    store_mib: int = Field(2048, ge=1, le=1 << 20, description="Maximum disk space of pushed models [MiB].")
    queue_s: float = Field(
        1.0,
        gt=0,
        le=60,
        description="A worker that is behind for this time leaves out whole windows; older packets are dropped [s].",
    )
    max_age_s: float = Field(
        1.0,
        gt=0,
        le=3600,
        description="Packets whose newest event is older are dropped and counted; a quarter of it is late [s].",
    )
    queue_mib: int = Field(64, ge=1, le=4096, description="Maximum size of the queue of a stream [MiB].")
    max_streams: int = Field(
        16, ge=1, le=1024, description="Maximum number of streams; further ones are refused and counted."
    )
    expect_streams: Annotated[Names, Field(description="Streams that must be served; health names a missing one.")] = ()
    allow_same_name: bool = Field(
        False, description="Start even if another node of this name is on the network; each estimate comes twice."
    )
    standby: Annotated[Literal["off", "lot", "last"], BeforeValidator(_standby)] = Field(
        "off",
        description="Stand by for other nodes on the same streams: one answers, the others follow and take over. lot: "
        "any node may answer first; last or true: the other nodes take precedence; off or false: answer every stream.",
    )
    streams: Annotated[tuple[Pattern, ...], NoDecode, BeforeValidator(_listed)] = Field(
        ("*",), min_length=1, description="Patterns of the names of the streams that this node serves, such as left_*."
    )
    copies: int = Field(
        0,
        ge=0,
        le=16,
        description="Share the streams: so many of the nodes that are alive serve each stream; 0: every node. It needs "
        "standby.",
    )
    capacity: int = Field(
        1, ge=1, le=1000, description="Share of the streams that this node takes, relative to others."
    )
    max_packet_events: int = Field(
        1_000_000,
        ge=1,
        le=(MAX_PACKET_BYTES - (1 << 16)) // 8,
        description="Larger packets are refused; the bound is the largest message of the transport, 32 MiB.",
    )
    refine: Literal["auto", "off"] = Field(
        "auto",
        description="Refine the angular velocity by the events of each window where a stream has a CameraInfo: auto or "
        "off.",
    )
    tables_mib: int = Field(
        512,
        ge=1,
        le=1 << 16,
        description="Maximum memory of the look-up tables of all sensors, 4 bytes a pixel and 8 for the "
        "refinement; further sensors are refused [MiB].",
    )
    max_side_px: int = Field(4096, ge=16, le=32768, description="Larger sensors are refused.")
    idle_evict_s: float = Field(
        30.0, gt=0, le=86_400, description="A stream without packets for this time is evicted [s]."
    )
    status_period_s: float = Field(1.0, gt=0, le=60, description="Period of the status messages [s].")
    ring_windows: int = Field(
        64, ge=1, le=1024, description="Newest windows kept per stream, to prime a new model with."
    )
    ring_mib: int = Field(4, ge=1, le=1024, description="Maximum size of these windows per stream [MiB].")
    prime_s: float = Field(
        15.0, ge=0, le=600, description="Maximum wait of a new model that needs more windows than are kept [s]."
    )
    probation_s: float = Field(
        10.0, ge=0, le=3600, description="Probation of a new model, in which a rollback is exact [s]."
    )
    shadow_divergence: float = Field(
        1.0,
        gt=0,
        description="Maximum RMS difference to the active model in shadow, divided by the active model's RMS.",
    )
    probation_divergence: float = Field(
        3.0, gt=0, description="The same on probation; beyond it the node rolls back automatically."
    )
    uncertain_m_s: float | None = Field(
        None,
        gt=0,
        description="A linear sigma below this is never uncertain; without it the model's bound, or 0.2 [m/s].",
    )
    uncertain_rad_s: float | None = Field(
        None, gt=0, description="The same for the angular sigma; without it the model's bound, or 0.1 [rad/s]."
    )

    metrics: Annotated[str, AfterValidator(check_address)] | None = Field(
        None,
        description="HOST:PORT for /metrics (Prometheus), /live, /ready and /health; none: no server. Extra metrics.",
    )

    @model_validator(mode="before")
    @classmethod
    def _a_client_only_connects(cls, values: dict[str, Any]) -> dict[str, Any]:
        if values.get("mode") == "client":
            return {"listen": ()} | values
        return values

    @field_validator("connect")
    @classmethod
    def _a_client_connects(cls, connect: tuple[str, ...], info: ValidationInfo) -> tuple[str, ...]:
        mode, listen = info.data.get("mode"), info.data.get("listen")
        if mode == "client" and not connect:
            raise ValueError("client mode needs an endpoint to connect to")
        if not connect and listen == () and info.data.get("zenoh_config") is None:
            raise ValueError(
                f"{mode} mode needs an endpoint to listen on or to connect to: nothing could reach this node"
            )
        return connect

    @field_validator("copies")
    @classmethod
    def _sharing_needs_standby(cls, copies: int, info: ValidationInfo) -> int:
        if copies and info.data.get("standby") == "off":
            raise ValueError("it needs standby, so that streams move between nodes without a gap")
        return copies

    @property
    def state_folder(self) -> Path | None:
        """Folder of pushed models and of active.json; None: nothing is stored."""
        return self.state_dir or self.models_dir

    @property
    def limits(self) -> PacketLimits:
        """Limits of event packets."""
        return PacketLimits(self.max_packet_events, self.max_side_px)


SettingsT = TypeVar("SettingsT", bound=_Settings)


def load(kind: type[SettingsT], flags: dict[str, Any], file: Path | None = None) -> tuple[SettingsT, dict[str, str]]:
    """The settings of a command, and the source of each value.

    Args:
        kind: ServiceConfig or ClientConfig.
        flags: values from the command line; None means not given.
        file: TOML file, if given.

    Raises:
        ConfigError: for the first wrong setting.
    """
    layers = [
        (f"file {file}" if file else "file", _from_file(file) if file else {}),
        ("environment", _from_environment(kind)),
        ("flag", {name: value for name, value in flags.items() if value is not None}),
    ]
    values: dict[str, Any] = {}
    origin = dict.fromkeys(kind.model_fields, "default")
    for where, layer in layers:
        values |= layer
        origin |= dict.fromkeys(layer, where)
    try:
        return kind(**values), origin
    except ValidationError as error:
        wrong = WrongField.of(error)
        field = str(wrong.path[0])
        raise _wrong(field, wrong.value, wrong.why, origin[field], kind) from None
    except NeuroVEError as error:  # a name or prefix that is not a valid key
        field = str(error.details.get("field"))
        raise _wrong(field, values.get(field), str(error.details.get("bound")), origin.get(field, "?"), kind) from None


def _wrong(field: str, value: object, why: str, where: str, kind: type[_Settings]) -> ConfigError:
    if field not in kind.model_fields:
        why = f"unknown setting; known settings: {', '.join(sorted(kind.model_fields))}"
    return ConfigError(f"config: {field}={value!r} (from {where}): {why}", field=field, value=repr(value), bound=why)


def _from_file(file: Path) -> dict[str, Any]:
    try:
        return read_toml(file)
    except OSError as error:
        raise ConfigError(f"config file {file}: {error.strerror}") from None
    except ValueError as error:  # not TOML, not UTF-8
        raise ConfigError(f"config file {file}: {error}") from None


def _from_environment(kind: type[_Settings]) -> dict[str, Any]:
    """The settings in the environment; an empty variable counts as unset."""
    known = {*ServiceConfig.model_fields, *ClientConfig.model_fields, *_OF_ENGINE}
    foreign = []
    for name, value in os.environ.items():
        rest = name.removeprefix(ENVIRONMENT)
        if not name.startswith(ENVIRONMENT) or rest.lower() in known or not value.strip():
            continue
        if not _OF_KUBERNETES.fullmatch(rest):
            raise _wrong(rest.lower(), value, "", "environment", kind)
        foreign.append(name)
    if foreign:
        log.warning("ignored, set by Kubernetes for a service of this name: %s", ", ".join(sorted(foreign)))
    return {name: value for name, value in EnvSettingsSource(kind)().items() if str(value).strip()}
