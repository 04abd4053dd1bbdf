"""The commands of model bundles, which need no service: model new, average, inspect, keygen, sign, verify.

Exit codes: 0 fine; 1 the model or its signature does not hold; 2 wrong usage, such as a missing file.
"""

import argparse
import functools
import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurove_core import self_test
from neurove_protocol.errors import BadModel, InvalidField, Untrusted
from neurove_service.cli.arguments import BAD_NEWS, Command, command
from neurove_service.cli.bundle_views import about, release_told, told

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey


def _judging(run: Command) -> Command:
    """A command that says why a model or its signature does not hold, and then ends with 1."""

    @functools.wraps(run)
    def judged(args: argparse.Namespace) -> int:
        try:
            return run(args)
        except (BadModel, Untrusted) as error:
            if args.json:
                print(json.dumps({"ok": False, "code": error.code, "message": error.message, **error.details}))
            else:
                print(f"neurove: {error.message}", file=sys.stderr)
            return BAD_NEWS

    return judged


def new_model(args: argparse.Namespace) -> int:
    """Write a bundle with random weights, to try a change of model with."""
    from neurove_core.models import bundle

    path: Path = args.file
    if path.suffix != bundle.SUFFIX:
        raise InvalidField("model new", "FILE", str(path), f"its name must end in {bundle.SUFFIX}")
    made = bundle.untrained(args.seed, name=path.stem)
    try:
        bundle.save(made, path)
    except OSError as error:
        raise InvalidField("model new", "FILE", str(path), error.strerror or str(error)) from None
    print(f"{path}: {made.name}, {made.digest[:12]}, untrained")
    return 0


@_judging
def average_models(args: argparse.Namespace) -> int:
    """Write the mean of several trainings of one model; calibrate it, for its errors are its own."""
    from neurove_core.models import bundle
    from neurove_core.training.averaging import average

    path: Path = args.out
    if path.suffix != bundle.SUFFIX:
        raise InvalidField("model average", "out", str(path), f"its name must end in {bundle.SUFFIX}")
    made = average([bundle.from_bytes(_bundle(file), file.name) for file in args.files])
    try:
        bundle.save(made, path)
    except OSError as error:
        raise InvalidField("model average", "out", str(path), error.strerror or str(error)) from None
    if args.json:
        print(json.dumps({"ok": True, "bundle": str(path), "digest": made.digest}))
    else:
        print(f"{path}: {made.name}, {made.digest[:12]}, not calibrated: neurove calibrate {path} --config CONFIG")
    return 0


@_judging
def inspect_model(args: argparse.Namespace) -> int:
    """What a bundle's file holds: header, tensors, digest, size, and who signed it."""
    from neurove_core.models import bundle, manifest

    data, signature = _bundle(args.file), _signature(args.file)
    trusted = [_public(path) for path in args.trust]
    found = bundle.from_bytes(data, args.file.name)
    state: dict[str, Any] = {"state": "none"}
    if signature is not None:
        try:
            signed = manifest.verify(data, signature, trusted) if trusted else manifest.read(signature)
            state = {"state": "valid" if trusted else "unchecked", **signed.model_dump()}
        except Untrusted as error:
            state = {"state": "refused", "reason": error.details["reason"], "why": error.message.partition(": ")[2]}
    everything = about(found, data) | {"signature": state}
    print(json.dumps(everything) if args.json else "\n".join(told(everything)))
    return BAD_NEWS if state["state"] == "refused" else 0


def keygen(args: argparse.Namespace) -> int:
    """Make a pair of keys: the private one signs models, nodes trust the public one."""
    from neurove_core.models import signing_keys

    key = signing_keys.new()
    private, public = args.out / f"{args.name}.key", args.out / f"{args.name}.pub"
    for path in (private, public):
        if path.exists():
            raise InvalidField("model keygen", "file", str(path), "it is there already, and a key is never overwritten")
    try:
        args.out.mkdir(parents=True, exist_ok=True)
        _write_new(private, signing_keys.private_pem(key), 0o600)
        _write_new(public, signing_keys.public_pem(key.public_key()), 0o644)
    except OSError as error:
        raise InvalidField("model keygen", "--out", str(args.out), error.strerror or str(error)) from None
    made = {"key_id": signing_keys.key_id(key.public_key()), "private": str(private), "public": str(public)}
    if args.json:
        print(json.dumps(made))
    else:
        print(f"key {made['key_id']}")
        print(f"{private}: private, yours alone; who has it can sign models")
        print(f"{public}: public, for those who are to trust it")
    return 0


@_judging
def sign_model(args: argparse.Namespace) -> int:
    """Sign a bundle: writes BUNDLE.sig beside it."""
    from neurove_core.files import write_atomically
    from neurove_core.models import bundle, manifest, signing_keys

    key = signing_keys.read_private(_read(args.key, signing_keys.MAX_KEY_BYTES), str(args.key))
    data, path = _bundle(args.bundle), args.bundle.with_name(args.bundle.name + manifest.SUFFIX)
    bundle.from_bytes(data, args.bundle.name)  # nobody vouches for what no node would load
    signature = manifest.sign(data, key, release=args.release, allow_downgrade=args.allow_downgrade)
    try:
        write_atomically(path, signature)
    except OSError as error:
        raise InvalidField("model sign", "file", str(path), error.strerror or str(error)) from None
    signed = manifest.read(signature)
    if args.json:
        print(json.dumps({"file": str(path), **signed.model_dump()}))
    else:
        print(f"{path}: {signed.name} {signed.sha256[:12]}, {release_told(signed.model_dump())}")
    return 0


@_judging
def verify_model(args: argparse.Namespace) -> int:
    """Whether a node that trusts these keys would take a bundle: signature, contents, golden test."""
    from neurove_core.estimator import Estimator
    from neurove_core.models import bundle, manifest

    data, name = _bundle(args.bundle), args.bundle.name
    trusted, signature = [_public(path) for path in args.trust], _signature(args.bundle)
    if signature is None:
        raise Untrusted(name, "unsigned", f"there is no {name}{manifest.SUFFIX} beside it")
    signed = manifest.verify(data, signature, trusted, name)
    found = bundle.from_bytes(data, name)
    self_test.check(Estimator(found))
    if args.json:
        print(json.dumps({"ok": True, **signed.model_dump(), "golden": found.golden is not None}))
    else:
        test = "its golden test holds" if found.golden else "it has no golden test"
        print(f"{args.bundle}: good: {signed.name} {signed.sha256[:12]}, {release_told(signed.model_dump())}; {test}")
    return 0


def _read(path: Path, most: int) -> bytes:
    """The bytes of a file that the command line names, one more than `most` at most; a missing one is wrong usage."""
    try:
        with path.open("rb") as file:
            return file.read(most + 1)
    except OSError as error:
        raise InvalidField("model", "file", str(path), error.strerror or str(error)) from None


def _bundle(path: Path) -> bytes:
    from neurove_core.models import bundle

    data = _read(path, bundle.MAX_BYTES)
    if len(data) > bundle.MAX_BYTES:
        raise BadModel(path.name, f"a bundle has at most {bundle.MAX_BYTES} bytes")
    return data


def _signature(path: Path) -> bytes | None:
    """The bytes of the signature file beside a bundle, or None; one byte more than allowed where it is too large."""
    from neurove_core.models import manifest

    try:
        with path.with_name(path.name + manifest.SUFFIX).open("rb") as file:
            return file.read(manifest.MAX_SIGNATURE_BYTES + 1)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise InvalidField("model", "file", path.name + manifest.SUFFIX, error.strerror or str(error)) from None


def _public(path: Path) -> "Ed25519PublicKey":
    from neurove_core.models import signing_keys

    return signing_keys.read_public(_read(path, signing_keys.MAX_KEY_BYTES), str(path))


def _write_new(path: Path, data: bytes, mode: int) -> None:
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def add(commands: Any) -> None:
    """Add these commands to the parser."""
    parser = commands.add_parser("model", help="Model bundles.").add_subparsers(required=True, metavar="COMMAND")
    trust = "public keys of those who may make models"
    new = command(parser, "new", new_model, as_json=False)
    new.add_argument("file", type=Path, metavar="FILE", help="bundle to write, ending in .safetensors")
    new.add_argument("--seed", type=int, default=0, help="of the weights")
    mean = command(parser, "average", average_models)
    mean.add_argument("files", type=Path, nargs="+", metavar="FILE", help="bundles of one network, 2 to 8")
    mean.add_argument("--out", type=Path, required=True, metavar="FILE", help="where to write the mean")
    inspect = command(parser, "inspect", inspect_model)
    inspect.add_argument("file", type=Path, metavar="BUNDLE", help="to read, and BUNDLE.sig where there is one")
    inspect.add_argument("--trust", type=Path, action="extend", nargs="+", default=[], metavar="PUB", help=trust)
    keys = command(parser, "keygen", keygen)
    keys.add_argument("--out", type=Path, default=Path(), metavar="DIR", help="folder to write them to; default here")
    keys.add_argument(
        "--name", type=_key_name, default="neurove", help="of the files; default neurove.key, neurove.pub"
    )
    sign = command(parser, "sign", sign_model)
    sign.add_argument("bundle", type=Path, metavar="BUNDLE", help="to sign")
    sign.add_argument("--key", type=Path, required=True, metavar="KEY", help="private key from `neurove model keygen`")
    sign.add_argument("--release", type=_release, metavar="N", help="counter; default: the one in the bundle's header")
    sign.add_argument("--allow-downgrade", action="store_true", help="nodes may take it after a higher release")
    verify = command(parser, "verify", verify_model)
    verify.add_argument("bundle", type=Path, metavar="BUNDLE", help="to check, with BUNDLE.sig beside it")
    verify.add_argument("--trust", type=Path, action="extend", nargs="+", required=True, metavar="PUB", help=trust)


def _release(text: str) -> int:
    from neurove_core.models.metadata import MAX_RELEASE

    try:
        value = int(text)
    except ValueError:
        value = -1
    if not 0 <= value <= MAX_RELEASE:
        raise argparse.ArgumentTypeError(f"{text!r}: give a whole number from 0 to {MAX_RELEASE}")
    return value


def _key_name(text: str) -> str:
    if not text or Path(text).name != text:
        raise argparse.ArgumentTypeError(f"{text!r}: give a file name without folders")
    return text
