"""The command bundle, which needs no service: new, average, scale, inspect, keygen, sign, verify.

Exit codes: 0 fine; 1 the bundle or its signature is not valid; 2 wrong usage, such as a missing file.
"""

import argparse
import functools
import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurove_protocol.errors import EXIT_FAILURE, BadModel, InvalidField, Untrusted
from neurove_service.cli.arguments import Run, add_force, refuse_existing, seed, subcommand
from neurove_service.cli.bundle_views import fields, lines, release_line
from neurove_service.cli.parser import Parser

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey


def _checking(run: Run) -> Run:
    """A command that reports why a bundle or its signature is not valid, and then ends with exit code 1."""

    @functools.wraps(run)
    def checked(args: argparse.Namespace) -> int:
        try:
            return run(args)
        except (BadModel, Untrusted) as error:
            if args.json:
                print(json.dumps({"ok": False, "code": error.code, "message": error.message, **error.details}))
            else:
                print(f"neurove: {error.message}", file=sys.stderr)
            return EXIT_FAILURE

    return checked


def new(args: argparse.Namespace) -> int:
    """Write a bundle with random weights, for trials of a model change."""
    from neurove_core.models import bundle

    path: Path = args.file
    if path.suffix != bundle.SUFFIX:
        raise InvalidField("bundle new", "FILE", str(path), f"its name must end in {bundle.SUFFIX}")
    refuse_existing("bundle new", "FILE", path, None, force=args.force)
    made = bundle.untrained(args.seed, name=path.stem)
    try:
        bundle.save(made, path)
    except OSError as error:
        raise InvalidField("bundle new", "FILE", str(path), error.strerror or str(error)) from None
    print(f"{path}: {made.name}, {made.digest[:12]}, untrained")
    return 0


@_checking
def average(args: argparse.Namespace) -> int:
    """Write the mean of several trainings of one model; calibrate it next, because its errors differ."""
    from neurove_core.models import bundle
    from neurove_core.training import averaging

    path: Path = args.out
    if path.suffix != bundle.SUFFIX:
        raise InvalidField("bundle average", "--out", str(path), f"its name must end in {bundle.SUFFIX}")
    refuse_existing("bundle average", "--out", path, None, force=args.force)
    made = averaging.average([bundle.from_bytes(_bundle(file), file.name) for file in args.files])
    try:
        bundle.save(made, path)
    except OSError as error:
        raise InvalidField("bundle average", "--out", str(path), error.strerror or str(error)) from None
    if args.json:
        print(json.dumps({"ok": True, "bundle": str(path), "digest": made.digest}))
    else:
        print(f"{path}: {made.name}, {made.digest[:12]}, not calibrated: neurove calibrate {path} --config CONFIG")
    return 0


@_checking
def scale(args: argparse.Namespace) -> int:
    """Write a bundle that also runs on longer windows, for slow motion; its weights stay the same."""
    from neurove_core import self_test
    from neurove_core.models import bundle

    path: Path = args.out
    if path.suffix != bundle.SUFFIX:
        raise InvalidField("bundle scale", "--out", str(path), f"its name must end in {bundle.SUFFIX}")
    refuse_existing("bundle scale", "--out", path, None, force=args.force)
    given = bundle.from_bytes(_bundle(args.file), args.file.name)
    bounds = tuple(args.bounds or given.config.scale_bounds)
    made = self_test.with_scales(given, tuple(args.scales), (bounds[0], bounds[1]))
    try:
        bundle.save(made, path)
    except OSError as error:
        raise InvalidField("bundle scale", "--out", str(path), error.strerror or str(error)) from None
    if args.json:
        print(json.dumps({"ok": True, "bundle": str(path), "digest": made.digest}))
    else:
        print(f"{path}: {made.name}, {made.digest[:12]}, scales {' '.join(map(str, args.scales)) or 'none'}")
    return 0


@_checking
def inspect(args: argparse.Namespace) -> int:
    """Show what a bundle holds: header, tensors, digest, size and signature."""
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
            state = {"state": "refused", "reason": error.details["reason"], "why": error.why}
    everything = fields(found, data) | {"signature": state}
    print(json.dumps(everything) if args.json else "\n".join(lines(everything)))
    return EXIT_FAILURE if state["state"] == "refused" else 0


def keygen(args: argparse.Namespace) -> int:
    """Make a pair of keys: the private key signs bundles, nodes trust the public key."""
    from neurove_core.models import signing_keys

    key = signing_keys.new()
    private, public = args.out / f"{args.name}.key", args.out / f"{args.name}.pub"
    for path in (private, public):
        if path.exists():
            raise InvalidField("bundle keygen", "file", str(path), "the file exists, and a key is never overwritten")
    try:
        args.out.mkdir(parents=True, exist_ok=True)
        _write_new(private, signing_keys.private_pem(key), 0o600)
        try:
            _write_new(public, signing_keys.public_pem(key.public_key()), 0o644)
        except BaseException:
            private.unlink()  # half a pair is no use, and blocks its name
            raise
    except OSError as error:
        raise InvalidField("bundle keygen", "--out", str(args.out), error.strerror or str(error)) from None
    made = {"key_id": signing_keys.key_id(key.public_key()), "private": str(private), "public": str(public)}
    if args.json:
        print(json.dumps(made))
    else:
        print(f"key {made['key_id']}")
        print(f"{private}: private; keep it secret: its owner can sign bundles")
        print(f"{public}: public; give it to the nodes that are to trust you")
    return 0


@_checking
def sign(args: argparse.Namespace) -> int:
    """Sign a bundle: write BUNDLE.sig next to it."""
    from neurove_core.files import write_atomically
    from neurove_core.models import bundle, manifest, signing_keys

    key = signing_keys.read_private(_read(args.key, signing_keys.MAX_KEY_BYTES), str(args.key))
    data, path = _bundle(args.bundle), args.bundle.with_name(args.bundle.name + manifest.SUFFIX)
    refuse_existing("bundle sign", "file", path, None, force=args.force)
    bundle.from_bytes(data, args.bundle.name)  # sign nothing that no node would load
    signature = manifest.sign(data, key, release=args.release, allow_downgrade=args.allow_downgrade)
    try:
        write_atomically(path, signature)
    except OSError as error:
        raise InvalidField("bundle sign", "file", str(path), error.strerror or str(error)) from None
    signed = manifest.read(signature)
    if args.json:
        print(json.dumps({"file": str(path), **signed.model_dump()}))
    else:
        print(f"{path}: {signed.name} {signed.sha256[:12]}, {release_line(signed.model_dump())}")
    return 0


@_checking
def verify(args: argparse.Namespace) -> int:
    """Check that a node that trusts these keys would accept a bundle: signature, contents, golden test."""
    from neurove_core import self_test
    from neurove_core.estimator import Estimator
    from neurove_core.models import bundle, manifest

    data, name = _bundle(args.bundle), args.bundle.name
    trusted, signature = [_public(path) for path in args.trust], _signature(args.bundle)
    if signature is None:
        raise Untrusted(name, "unsigned", f"there is no {name}{manifest.SUFFIX} next to it")
    signed = manifest.verify(data, signature, trusted, name)
    found = bundle.from_bytes(data, name)
    self_test.check(Estimator(found))
    if args.json:
        print(json.dumps({"ok": True, **signed.model_dump(), "golden": found.golden is not None}))
    else:
        test = "its golden test holds" if found.golden else "it has no golden test"
        print(f"{args.bundle}: good: {signed.name} {signed.sha256[:12]}, {release_line(signed.model_dump())}; {test}")
    return 0


def _read(path: Path, most: int) -> bytes:
    """Read at most `most` + 1 bytes of a file that the command line names; a missing file is wrong usage."""
    try:
        with path.open("rb") as file:
            return file.read(most + 1)
    except OSError as error:
        raise InvalidField("bundle", "file", str(path), error.strerror or str(error)) from None


def _file(text: str) -> Path:
    """The file of a bundle, from its path or from the name of a built-in model."""
    from neurove_core import models

    return models.file_of(text)


def _bundle(path: Path) -> bytes:
    from neurove_core.models import bundle

    data = _read(path, bundle.MAX_BYTES)
    if len(data) > bundle.MAX_BYTES:
        raise BadModel(path.name, f"a bundle has at most {bundle.MAX_BYTES} bytes")
    return data


def _signature(path: Path) -> bytes | None:
    """The bytes of a bundle's signature file, at most one more than allowed; None if there is no such file."""
    from neurove_core.models import manifest

    try:
        with path.with_name(path.name + manifest.SUFFIX).open("rb") as file:
            return file.read(manifest.MAX_SIGNATURE_BYTES + 1)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise InvalidField("bundle", "file", path.name + manifest.SUFFIX, error.strerror or str(error)) from None


def _public(path: Path) -> "Ed25519PublicKey":
    from neurove_core.models import signing_keys

    return signing_keys.read_public(_read(path, signing_keys.MAX_KEY_BYTES), str(path))


def _write_new(path: Path, data: bytes, mode: int) -> None:
    """Write a new file with these permissions, or nothing."""
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
        try:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        except BaseException:
            path.unlink()
            raise


def add_bundle(parser: Parser) -> None:
    """Add the commands of `neurove bundle`."""
    commands = parser.add_commands()
    one = subcommand(commands, "new", new, as_json=False)
    one.add_argument("file", type=Path, metavar="FILE", help="bundle to write, ending in .safetensors")
    one.add_argument("--seed", type=seed, default=0, metavar="N", help="seed of the weights; default 0")
    add_force(one, "FILE")
    one = subcommand(commands, "inspect", inspect)
    about = "bundle to show, with BUNDLE.sig if it exists; a file or a built-in name such as `default`"
    one.add_argument("file", type=_file, metavar="BUNDLE", help=about)
    _add_trust(one, default=[])
    one = subcommand(commands, "average", average)
    about = "2 to 8 bundles of one network: files or built-in names"
    one.add_argument("files", type=_file, nargs="+", metavar="BUNDLE", help=about)
    one.add_argument("--out", type=Path, required=True, metavar="FILE", help="bundle to write")
    add_force(one, "FILE")
    one = subcommand(commands, "scale", scale)
    one.add_argument("file", type=_file, metavar="BUNDLE", help="trained bundle: a file or a built-in name")
    about = "longer windows, in windows, rising, such as 2 4 8; none: one window only"
    one.add_argument("--scales", type=int, nargs="*", required=True, metavar="N", help=about)
    about = "greatest linear (1/s for a model per height, else m/s) and angular [rad/s] speed, times the scale"
    one.add_argument("--bounds", type=float, nargs=2, metavar=("V", "W"), help=f"{about}; default: those of the bundle")
    one.add_argument("--out", type=Path, required=True, metavar="FILE", help="bundle to write")
    add_force(one, "FILE")
    one = subcommand(commands, "sign", sign)
    one.add_argument("bundle", type=Path, metavar="BUNDLE", help="bundle to sign")
    one.add_argument("--key", type=Path, required=True, metavar="KEY", help="private key from `neurove bundle keygen`")
    one.add_argument("--release", type=_release, metavar="N", help="release counter; default: that of the bundle")
    one.add_argument("--allow-downgrade", action="store_true", help="let nodes accept it after a higher release")
    add_force(one, "BUNDLE.sig")
    one = subcommand(commands, "verify", verify)
    one.add_argument("bundle", type=Path, metavar="BUNDLE", help="bundle to check, with BUNDLE.sig next to it")
    _add_trust(one, required=True)
    one = subcommand(commands, "keygen", keygen)
    one.add_argument("--out", type=Path, default=Path(), metavar="DIR", help="folder to write to; default: this folder")
    about = "name of the two files; default neurove: neurove.key and neurove.pub"
    one.add_argument("--name", type=_key_name, default="neurove", help=about)


def _add_trust(parser: argparse.ArgumentParser, **options: Any) -> None:
    about = "public keys whose signatures are accepted"
    parser.add_argument("--trust", type=Path, action="extend", nargs="+", metavar="PUB", help=about, **options)


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
