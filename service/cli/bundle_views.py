"""A bundle as `neurove bundle inspect` prints it: fields for JSON, lines for people."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neurove_core.models.bundle import Bundle


def fields(found: "Bundle", data: bytes) -> dict[str, Any]:
    """All fields of a bundle, as plain values for JSON.

    Args:
        found: the bundle.
        data: the bytes that it was read from.
    """
    import safetensors.numpy

    tensors = safetensors.numpy.load(data)
    return {
        **found.info.model_dump(),
        "size": len(data),
        **found.metadata.model_dump(mode="json"),
        "prime_windows": found.prime_windows,
        "linear_unit": found.linear_unit,
        "config": found.config.model_dump(mode="json"),
        "golden": found.golden and {"windows": len(found.golden.counts), "tolerance": found.golden.tolerance},
        "tensors": {
            name: {"dtype": str(one.dtype), "shape": list(one.shape), "bytes": one.nbytes}
            for name, one in sorted(tensors.items())
        },
    }


def lines(about: dict[str, Any]) -> Iterator[str]:
    """The lines that people read, from what `fields` returns and its `signature`."""
    window, grid, net = (about["config"][part] for part in ("window", "canonical", "network"))
    longer = about["config"].get("scales", ())
    rows = {
        "name": about["name"],
        "release": about["release"],
        "digest": about["digest"],
        "size": f"{about['size']:,} bytes, {len(about['tensors'])} tensors, {about['parameters']:,} parameters",
        "trained": "yes" if about["trained"] else "no: its estimates have no meaning",
        "provenance": about["provenance"],
        "made by": _pairs(about["made_by"], skip=("recipe", "data")),
        "recipe": _pairs(about["made_by"] and about["made_by"]["recipe"]),
        "data": _pairs(about["made_by"] and about["made_by"]["data"]),
        "figures": _pairs(about["figures"]),
        "answers": f"{about['linear_unit']} and rad/s",
        "windows": f"{window['duration_us'] / 1e3:g} ms in {window['bins']} bins, settled after "
        f"{about['config']['settle_windows']}, primed with {about['prime_windows']}"
        + (f"; for slow motion also {', '.join(map(str, longer))} windows at once" if longer else ""),
        "camera": f"{grid['width']}x{grid['height']}, {grid['hfov_deg']:g} degrees wide"
        + (f", each cell in {grid['subcells'] ** 2} parts" if "subcells" in grid else ""),
        "network": _pairs(net),
        "limits": _pairs(about["limits"]),
        "golden": _pairs(about["golden"]),
        "signature": _signature_line(about["signature"]),
    }
    yield from (f"{what:<11}{value}" for what, value in rows.items())
    yield "tensors"
    yield from (f"  {name:<32}{one['dtype']:<9}{one['shape']}" for name, one in about["tensors"].items())


def release_line(signed: dict[str, Any]) -> str:
    """The release and the key of a manifest, in one line."""
    downgrade = ", downgrade allowed" if signed["allow_downgrade"] else ""
    return f"release {signed['release']}{downgrade}, signed by key {signed['key_id']} at {signed['created']}"


def _pairs(fields: dict[str, Any] | None, skip: tuple[str, ...] = ()) -> str:
    pairs = {name: value for name, value in (fields or {}).items() if name not in skip and value is not None}
    shown = (f"{name} {value:.6g}" if isinstance(value, float) else f"{name} {value}" for name, value in pairs.items())
    return ", ".join(shown) or "none"


def _signature_line(state: dict[str, Any]) -> str:
    if "release" not in state:
        return "none" if state["state"] == "none" else f"refused: {state['why']}"
    valid = "valid" if state["state"] == "valid" else "not checked (give the keys that you trust: --trust PUB)"
    return f"{valid}, {release_line(state)}"
