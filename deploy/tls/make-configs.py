"""One Zenoh configuration for every certificate that make-ca.sh made, with keys and access list inside.

    python make-configs.py DIR [--prefix neurove/v1] [--listen tls/0.0.0.0:7447]

DIR/NAME.json5 is all that a participant needs: give the file to `neurove ... --zenoh-config`, and keep it secret. The
router's (and that of a node which listens itself) lists who may do what. Files are written anew each time: after a
certificate came or went, run it again, copy the router's file and restart the router.
"""

import argparse
import base64
import json
import os
import re
import subprocess
import sys
from pathlib import Path

ROLES = ("router", "node", "driver", "consumer", "recorder", "operator")
TEMPLATES = Path(__file__).resolve().parent
IN, OUT = "ingress", "egress"  # as the listening side sees it: from the participant, to the participant


def access_control(names: list[str], prefix: str) -> dict[str, object]:
    """Zenoh's `access_control` for these participants: default deny, and one policy for each.

    Zenoh applies a rule only if its key expression includes that of the message, so a wildcard put or a question to
    `**` is denied by every rule with a narrower key.

    Args:
        names: common names of certificates, `<role>-<name>`.
        prefix: of all keys.
    """
    rules = [
        {"id": f"{name} {number}", "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": keys}
        for name in names
        for number, (flow, messages, keys) in enumerate(_rules(*name.split("-", 1), prefix))
    ]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": name, "cert_common_names": [name]} for name in names],
        "policies": [
            {"rules": [rule["id"] for rule in rules if str(rule["id"]).split(" ")[0] == name], "subjects": [name]}
            for name in names
            if any(str(rule["id"]).split(" ")[0] == name for rule in rules)
        ],
    }


Rule = tuple[str, list[str], list[str]]


def _rules(role: str, name: str, prefix: str) -> list[Rule]:
    """What a participant may send (IN) and be sent (OUT): flow, kinds of message, key expressions."""
    node = f"{prefix}/@node/*"
    events, camera = f"{prefix}/*/events", f"{prefix}/*/camera"
    told = [f"{prefix}/*/velocity", f"{prefix}/*/status"]
    asked = [f"{node}/health", f"{node}/models"]
    change, chunks = f"{node}/model/**", f"{prefix}/@push/**"
    own = f"{prefix}/@node/{name}"
    if role == "driver":  # the events and the camera of its own stream
        return [
            *_publishes([f"{prefix}/{name}/events", f"{prefix}/{name}/camera"], heard_as=[events, camera]),
            *_answers([f"{prefix}/{name}/camera"], asked_as=[camera]),
        ]
    if role == "node":  # everything that a service does, under its own name
        return [
            *_hears([events, camera]),
            *_asks([camera, chunks]),
            *_publishes(told, heard_as=told),
            *_answers([f"{own}/health", f"{own}/models", f"{own}/model/**"], asked_as=[*asked, change]),
            (IN, ["reply"], [change]),  # a refusal bears the key of the question, which may ask all nodes
            (IN, ["liveliness_token"], [f"{own}/alive", f"{own}/serves/*"]),
        ]
    reads = [
        *_hears(told),
        *_asks(asked),
        (IN, ["liveliness_query", "declare_liveliness_subscriber"], [f"{node}/alive", f"{node}/serves/*"]),
        (OUT, ["liveliness_token"], [f"{node}/alive", f"{node}/serves/*"]),
    ]
    if role == "recorder":  # what a consumer may, and the events
        return [*reads, *_hears([events, camera]), *_asks([camera])]
    if role == "operator":  # what a consumer may, and to change models
        return [*reads, *_asks([change]), *_answers([chunks], asked_as=[chunks])]
    return reads if role == "consumer" else []


def _hears(keys: list[str]) -> list[Rule]:
    return [(IN, ["declare_subscriber"], keys), (OUT, ["put"], keys)]


def _publishes(keys: list[str], *, heard_as: list[str]) -> list[Rule]:
    return [(IN, ["put"], keys), (OUT, ["declare_subscriber"], heard_as)]  # else it would not know of a listener


def _asks(keys: list[str]) -> list[Rule]:
    return [(IN, ["query"], keys), (OUT, ["declare_queryable", "reply"], keys)]


def _answers(keys: list[str], *, asked_as: list[str]) -> list[Rule]:
    return [(IN, ["declare_queryable", "reply"], keys), (OUT, ["query"], asked_as)]


def listens(certificate: Path) -> bool:
    """Whether others may connect to the holder: make-ca.sh says so in the certificate where it was given hosts."""
    command = ["openssl", "x509", "-in", str(certificate), "-noout", "-purpose"]
    told = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    return "SSL server : Yes" in told


def config(folder: Path, name: str, access: dict[str, object], endpoint: str) -> str:
    """The text of a participant's configuration."""
    server = listens(folder / f"{name}.crt")
    text = (TEMPLATES / ("listen.json5" if server else "connect.json5")).read_text(encoding="utf-8")
    values = {
        "NAME": name,
        "MODE": json.dumps("router" if name.startswith("router-") else "peer"),
        "LISTEN": json.dumps([endpoint]),
        "CA": json.dumps(_base64(folder / "ca.crt")),
        "CERTIFICATE": json.dumps(_base64(folder / f"{name}.crt")),
        "KEY": json.dumps(_base64(folder / f"{name}.key")),
        "ACCESS_CONTROL": json.dumps(access, indent=2).replace("\n", "\n  "),
    }
    return re.sub(r"@([A-Z_]+)@", lambda found: values[found[1]], text)


def _base64(path: Path) -> str:
    return base64.b64encode(path.read_bytes()).decode()


def write(path: Path, text: str) -> None:
    """A file that only its owner can read, whole or not at all."""
    part = path.with_name(f".{path.name}")
    part.unlink(missing_ok=True)
    with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="utf-8") as file:
        file.write(text)
    part.replace(path)


def main() -> int:
    """Write all configurations of a folder."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", metavar="DIR", type=Path, help="the folder that make-ca.sh filled")
    parser.add_argument("--prefix", default="neurove/v1", help="of all keys; default neurove/v1")
    parser.add_argument(
        "--listen", default="tls/0.0.0.0:7447", help="where router and listening nodes listen; default tls/0.0.0.0:7447"
    )
    args = parser.parse_args()
    if not re.fullmatch(r"[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*", args.prefix):
        parser.error(f"--prefix {args.prefix!r}: chunks of A-Z a-z 0-9 _ . - joined by /")
    if not re.fullmatch(r"tls/[^/\s\"#]+:[0-9]+", args.listen):
        parser.error(f"--listen {args.listen!r}: give one address and port, such as tls/192.168.7.1:7447")
    names = sorted(path.stem for path in args.folder.glob("*-*.crt") if path.name.split("-")[0] in ROLES)
    if not names:
        parser.error(f"no certificates in {args.folder}: run make-ca.sh first")
    access = access_control(names, args.prefix)
    for name in names:
        write(args.folder / f"{name}.json5", config(args.folder, name, access, args.listen))
        print(f"wrote {args.folder / name}.json5")
    return 0


if __name__ == "__main__":
    sys.exit(main())
