"""Model bundle: one safetensors file. Its header holds configuration, units and provenance; its sha256 is its digest.

Nothing is unpickled. A file is checked before it is used: its size, its header, the names, shapes and types of all
tensors for the architecture that the header declares, and that all values are finite.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Final, Literal, Self, cast

import numpy as np
import safetensors.numpy
from numpy.typing import NDArray
from pydantic import Field, ValidationError, ValidationInfo, field_validator

from neurove_core.config import Config, ModelConfig
from neurove_core.extras import MissingExtra
from neurove_core.files import allow_no_temporary_folder, read_whole, write_atomically
from neurove_core.models import golden
from neurove_core.models.bounds import Bounds
from neurove_core.models.container import Data, object_without_duplicates, read_container, read_tensors
from neurove_core.models.golden import Golden
from neurove_core.models.lazy import NetworkField, TensorField, as_array
from neurove_core.models.metadata import BundleLimits, Metadata
from neurove_core.models.uncertainty import Uncertainty, why_no_correlation
from neurove_core.networks import arrays
from neurove_core.networks.arrays import Weights
from neurove_protocol.control import ModelInfo
from neurove_protocol.errors import BadModel, shown
from neurove_protocol.fields import WrongField

if TYPE_CHECKING:  # a service loads no torch
    from torch import Tensor

    from neurove_core.networks.kinds import Network

BUNDLE_VERSION: Final = 1
SUFFIX = ".safetensors"
MAX_BYTES = 256 << 20

LinearUnit = Literal["m/s", "1/s per m of height"]
METRIC: Final[LinearUnit] = "m/s"
PER_HEIGHT: Final[LinearUnit] = "1/s per m of height"

_KEY = "neurove"
_SMALL = _OFFSET, _SCALE, _CORRELATION = "output.offset", "output.scale", "output.correlation"


class UncertaintyHeader(Config):
    """Present if a bundle has a spread (tensors spread.weight, spread.bias, output.correlation): its calibration."""

    uncertain_above: float = Field(gt=0, description="Relative bound: sigma / speed, and angular sigma / rate.")
    provenance: str = Field(max_length=1000, description="One line: how the model was calibrated.")
    uncertain_m_s: float | None = Field(None, gt=0, description="Absolute bound of the linear sigma [m/s].")
    uncertain_rad_s: float | None = Field(None, gt=0, description="Absolute bound of the angular sigma [rad/s].")


class Header(Metadata):
    """The header of a bundle: JSON in the metadata of the safetensors file."""

    bundle_version: int = BUNDLE_VERSION
    name: str = Field(min_length=1, max_length=64, pattern="^[A-Za-z0-9_][A-Za-z0-9_.-]*$")
    trained: bool
    provenance: str = Field(max_length=1000, description="One line: how the model was made.")
    config: ModelConfig
    linear_unit: LinearUnit = Field(
        METRIC, description="Unit of the linear part: m/s, or per metre of the camera's height above the ground."
    )
    golden_tolerance: float | None = Field(
        None, gt=0, le=1, description="Tolerance of the golden test, if there is one."
    )
    uncertainty: UncertaintyHeader | None = Field(None, description="Calibration of the uncertainty, if there is one.")

    @field_validator("uncertainty")
    @classmethod
    def _of_a_neurove(cls, value: UncertaintyHeader | None, info: ValidationInfo) -> UncertaintyHeader | None:
        config = info.data.get("config")
        if value is not None and config is not None and config.kind != "neurove":
            raise ValueError(f"a network of kind={config.kind!r} has no uncertainty")
        return value


@dataclass(frozen=True)
class Bundle:
    """A model in memory."""

    name: str
    trained: bool
    provenance: str
    config: ModelConfig
    network: "Network"  # or its Weights, and the next two as arrays: see lazy.py
    offset: "Tensor"  # (6): twist = network output * scale + offset, in linear_unit and rad/s
    scale: "Tensor"  # (6)
    linear_unit: LinearUnit = METRIC
    metadata: Metadata = field(default_factory=Metadata)
    golden: Golden | None = None  # None: the self-test has nothing to compare and passes
    uncertainty: Uncertainty | None = None  # if present, the network has a spread
    digest: str = ""  # sha256 of the bundle's bytes, hex

    @property
    def info(self) -> ModelInfo:
        """What a node reports about this model."""
        return ModelInfo(
            name=self.name,
            digest=self.digest,
            trained=self.trained,
            provenance=self.provenance,
            parameters=self._parameters,
            release=self.release,
            figures=self.metadata.figures,
        )

    @property
    def release(self) -> int:
        """Release counter of this model."""
        return self.metadata.release

    @property
    def prime_windows(self) -> int:
        """Number of recent windows that a stream replays until the estimates of this model are settled."""
        windows = self.metadata.prime_windows
        return self.config.settle_windows if windows is None else windows

    @property
    def limits(self) -> BundleLimits:
        """Largest allowed differences from the model it replaces."""
        return self.metadata.limits or BundleLimits()

    @property
    def weights(self) -> Weights | None:
        """The weights as they were read from a file; None for a network in memory, which somebody may change."""
        stored = _NETWORK.stored(self)
        return stored if isinstance(stored, Weights) else None

    @property
    def current_weights(self) -> Weights:
        """The weights of a NeuroVE network as they are now; those of one in memory are copied."""
        if (weights := self.weights) is not None:
            return weights
        tensors = {name: array.copy() for name, array in _stored(self).items()}
        return Weights(self.config, tensors, spread="spread.weight" in tensors)

    @property
    def scaling(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Offset (6) and scale (6): twist = network output * scale + offset."""
        offset, scale = (as_array(field.stored(self)).astype(np.float64) for field in (_BUNDLE_OFFSET, _BUNDLE_SCALE))
        return offset, scale

    @property
    def weight_bytes(self) -> int:
        """Size of the weights in memory [bytes]."""
        if (weights := self.weights) is not None:
            return sum(array.nbytes for array in weights.tensors.values())
        from neurove_core.models.networks import bytes_of

        return bytes_of(self.network)

    @property
    def _parameters(self) -> int:
        if (weights := self.weights) is not None:
            return weights.parameters
        from neurove_core.models.networks import parameters_of

        return parameters_of(self.network)

    def to_bytes(self) -> bytes:
        """The bundle as the bytes of its file."""
        header = Header(
            name=self.name,
            trained=self.trained,
            provenance=self.provenance,
            config=self.config,
            linear_unit=self.linear_unit,
            golden_tolerance=self.golden.tolerance if self.golden else None,
            uncertainty=self.uncertainty and _header_of(self.uncertainty),
            **dict(self.metadata),
        )
        omitted: dict[str, bool | set[str]] = dict.fromkeys(
            Metadata.model_fields.keys() - self.metadata.non_default_fields(), True
        )
        if self.golden is None:
            omitted["golden_tolerance"] = True
        if header.uncertainty is None:
            omitted["uncertainty"] = True
        else:  # what is not set is not stored, so that the bytes of older bundles stay the same
            omitted["uncertainty"] = {name for name, value in header.uncertainty if value is None}
        offset, scale = (as_array(field.stored(self)) for field in (_BUNDLE_OFFSET, _BUNDLE_SCALE))
        tensors = {**_stored(self), _OFFSET: offset, _SCALE: scale}
        if self.golden:
            tensors |= golden.to_tensors(self.golden)
        if self.uncertainty is not None:
            tensors[_CORRELATION] = self.uncertainty.matrix
        tensors = {key: np.asarray(array, order="C") for key, array in tensors.items()}
        return safetensors.numpy.save(tensors, {_KEY: header.model_dump_json(exclude=omitted)})

    def with_digest(self) -> Self:
        """This bundle with its digest computed."""
        return replace(self, digest=hashlib.sha256(self.to_bytes()).hexdigest())


_NETWORK = NetworkField(Bundle, "network")
_BUNDLE_OFFSET, _BUNDLE_SCALE = TensorField(Bundle, "offset"), TensorField(Bundle, "scale")


def save(bundle: Bundle, path: Path) -> None:
    """Write a bundle's file atomically: an existing file stays until the new one is complete."""
    write_atomically(path, bundle.to_bytes())


def load(path: Path) -> Bundle:
    """Read and check a bundle's file.

    Raises:
        BadModel: the file is missing, damaged, of another format, or does not match its header; the message says why.
    """
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise BadModel(path.name, f"size={size}: a bundle has at most {MAX_BYTES} bytes")
        data = read_whole(path)
    except OSError as error:
        raise BadModel(path.name, error.strerror or str(error)) from None
    return from_bytes(data, path.name)


def from_bytes(data: Data, name: str) -> Bundle:
    """Check and load a bundle from its bytes.

    Args:
        data: the bytes of the file.
        name: of the file, for errors.

    Raises:
        BadModel: as `load`.
    """
    allow_no_temporary_folder()
    header = read_header(data, name)
    tensors = read_tensors(data, name)
    test = golden.from_tensors(tensors, header.config, header.golden_tolerance, name)
    wanted = {**_shapes(header), _OFFSET: (6,), _SCALE: (6,)}
    if header.uncertainty is not None:
        wanted[_CORRELATION] = (6, 6)
    _check_tensors(tensors, wanted, name)
    # copied, because the arrays are views of the whole file
    offset, scale, correlation = (tensors.pop(key).copy() if key in tensors else None for key in _SMALL)
    assert offset is not None
    assert scale is not None
    uncertainty = _uncertainty(header.uncertainty, correlation, name)
    return Bundle(
        name=header.name,
        trained=header.trained,
        provenance=header.provenance,
        config=header.config,
        network=cast("Network", Weights(header.config, tensors, spread=header.uncertainty is not None)),
        offset=cast("Tensor", offset),
        scale=cast("Tensor", scale),
        linear_unit=header.linear_unit,
        metadata=Metadata(**{name: getattr(header, name) for name in Metadata.model_fields}),
        golden=test,
        uncertainty=uncertainty,
        digest=hashlib.sha256(data).hexdigest(),
    )


def read_header(data: Data, name: str) -> Header:
    """Read and check the header in a bundle's bytes.

    Args:
        data: the bytes of the file.
        name: of the file, for errors.

    Raises:
        BadModel: as `load`.
    """
    entries = read_container(data, name).entries
    try:
        own = entries["__metadata__"][_KEY]
        fields = json.loads(own, object_pairs_hook=object_without_duplicates)
    except (KeyError, TypeError):
        raise BadModel(
            name, "a safetensors file, but not a NeuroVE bundle: its header has no 'neurove' entry"
        ) from None
    except (ValueError, RecursionError) as error:
        raise BadModel(name, f"its header cannot be read: {error}") from None
    version = fields.get("bundle_version") if isinstance(fields, dict) else None
    if version != BUNDLE_VERSION:
        raise BadModel(name, f"bundle_version={shown(version)}: this program reads version {BUNDLE_VERSION}")
    try:
        return Header.model_validate(fields)
    except ValidationError as error:
        wrong = WrongField.of(error)
        raise BadModel(name, f"header{' field' if wrong.path else ':'} {wrong.sentence}") from None


def untrained(seed: int = 0, config: ModelConfig | None = None, name: str = "untrained") -> Bundle:
    """A model with random weights: it runs like a trained one, but its estimates mean nothing.

    The norms have the statistics of random input, so that neurons fire. The same seed gives the same model on one
    machine and torch version.

    Args:
        seed: of the weights.
        config: of the model; the default is ModelConfig().
        name: of the model.

    Raises:
        MissingExtra: torch is not installed.
    """
    networks = _networks()
    config = config or ModelConfig()
    return Bundle(
        name=name,
        trained=False,
        provenance=f"random weights, neurove_core.models.bundle.untrained(seed={seed}), torch {networks.VERSION}",
        config=config,
        network=networks.with_random_weights(seed, config),
        offset=cast("Tensor", np.zeros(6, np.float32)),
        scale=cast("Tensor", np.ones(6, np.float32)),
    ).with_digest()


def _shapes(header: Header) -> dict[str, tuple[int, ...]]:
    spread = header.uncertainty is not None
    if header.config.kind == "neurove":
        return arrays.shapes(header.config, spread=spread)
    found: dict[str, tuple[int, ...]] = _networks().shapes(header.config, spread=spread)  # baselines run in torch alone
    return found


def _networks() -> ModuleType:
    """The module that needs torch."""
    try:
        from neurove_core.models import networks
    except ImportError as error:
        if error.name != "torch":
            raise
        raise MissingExtra("torch", "train") from None
    return networks


def _uncertainty(
    header: UncertaintyHeader | None, correlation: NDArray[np.float32] | None, name: str
) -> Uncertainty | None:
    if header is None or correlation is None:
        return None
    why = why_no_correlation(correlation)
    if why:
        raise BadModel(name, f"tensor {_CORRELATION!r} {why}")
    bounds = Bounds(header.uncertain_m_s, header.uncertain_rad_s)
    return Uncertainty(cast("Tensor", correlation), header.uncertain_above, header.provenance, bounds)


def _header_of(found: Uncertainty) -> UncertaintyHeader:
    return UncertaintyHeader(
        uncertain_above=found.uncertain_above,
        provenance=found.provenance,
        uncertain_m_s=found.bounds.m_s,
        uncertain_rad_s=found.bounds.rad_s,
    )


def _stored(model: Bundle) -> Mapping[str, NDArray[Any]]:
    if model.weights is not None:
        return model.weights.tensors
    from neurove_core.models.networks import arrays_of

    return arrays_of(model.network)


def _check_tensors(tensors: dict[str, NDArray[Any]], wanted: dict[str, tuple[int, ...]], name: str) -> None:
    for key in sorted(wanted.keys() ^ tensors.keys()):
        raise BadModel(name, f"tensor {key!r} is {'missing' if key in wanted else 'not one of this architecture'}")
    for key, tensor in tensors.items():
        if tensor.shape != wanted[key] or tensor.dtype != np.float32:
            got, needs = f"{tensor.dtype} {tensor.shape}", f"float32 {wanted[key]}"
            raise BadModel(name, f"tensor {key!r} is {got}, its header's architecture needs {needs}")
        if not bool(np.isfinite(tensor).all()):
            raise BadModel(name, f"tensor {key!r} holds values that are not finite")
