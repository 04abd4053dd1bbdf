"""Make one Zenoh configuration for every certificate of make-ca.sh, including keys and access list.

    python make-configs.py DIR [--prefix neurove/v1] [--listen tls/0.0.0.0:7447] [--domain 0]

DIR/NAME.json5 contains everything that a participant needs. Pass it to `neurove ... --zenoh-config` and keep it secret.
The file of a router, or of a node that listens itself, also has the access list of all participants. Each run rewrites
all files. After you add or remove a certificate, run the script again, copy the router's file and restart the router.
"""

import argparse
import base64
import json
import os
import re
import subprocess
import sys
from pathlib import Path

ROLES = ("router", "node", "driver", "consumer", "recorder", "operator", "bridge", "ros")
TEMPLATES = Path(__file__).resolve().parent
ALL = [
    *("put", "delete", "declare_subscriber", "query", "declare_queryable", "reply"),
    *("liveliness_token", "liveliness_query", "declare_liveliness_subscriber"),
]  # kinds of message
IN, OUT = "ingress", "egress"  # seen from the listening side: from the participant, to the participant


def access_control(names: list[str], prefix: str, domain: int = 0) -> dict[str, object]:
    """Make Zenoh's `access_control` for these participants: default deny, and one policy per participant.

    Zenoh applies a rule only if its key expression includes that of the message. A rule with a narrower key therefore
    does not permit a put with wildcards or a query to `**`.

    Args:
        names: common names of the certificates, `<role>-<name>`.
        prefix: prefix of all keys.
        domain: ROS_DOMAIN_ID, for participants of the roles bridge and ros.

    Returns:
        the value of `access_control`, ready for JSON.
    """
    rules = [
        {"id": f"{name} {number}", "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": keys}
        for name in names
        for number, (flow, messages, keys) in enumerate(_rules(*name.split("-", 1), prefix, domain))
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


def _rules(role: str, name: str, prefix: str, domain: int) -> list[Rule]:
    """List what a participant may send (IN) and receive (OUT): flow, kinds of message, key expressions."""
    node = f"{prefix}/@node/*"
    events, camera, imu = f"{prefix}/*/events", f"{prefix}/*/camera", f"{prefix}/*/imu"
    results = [f"{prefix}/*/velocity", f"{prefix}/*/status"]
    asked = [f"{node}/health", f"{node}/models"]
    change, chunks = f"{node}/model/**", f"{prefix}/@push/**"
    duty, drain = f"{node}/duty/*", f"{node}/drain"
    own, shared = f"{prefix}/@node/{name}", [f"{node}/serves/*", f"{node}/shares/*"]
    if role == "driver":  # events, camera and IMU of its own stream
        published = [f"{prefix}/{name}/{kind}" for kind in ("events", "camera", "imu")]
        return [
            *_publishes(published, heard_as=[events, camera, imu]),
            *_answers([f"{prefix}/{name}/camera"], asked_as=[camera]),
        ]
    if role == "node":  # everything that the service does, under its own name
        return [
            *_hears([events, camera, imu, results[0]]),
            *_asks([camera, chunks, duty]),  # the nodes that stand by for each other
            *_publishes(results, heard_as=results),
            *_answers(
                [f"{own}/health", f"{own}/models", f"{own}/model/**", f"{own}/duty/*", f"{own}/drain"],
                asked_as=[*asked, change, duty, drain],
            ),
            (IN, ["reply"], [change, duty]),  # an error reply has the key of the query, maybe for all nodes
            (IN, ["liveliness_query", "declare_liveliness_subscriber"], [f"{own}/instance/*", *shared]),
            (OUT, ["liveliness_token"], [f"{own}/instance/*", *shared]),
            (IN, ["liveliness_token"], [f"{own}/alive", f"{own}/serves/*", f"{own}/instance/*", f"{own}/shares/*"]),
        ]
    if role == "ros":  # a node of ROS 2: everything of its domain, and nothing of ours
        return _ros(domain)
    if role == "bridge":  # as the drivers of all streams and a consumer of results, and a node of ROS 2
        published = [events, camera, imu]
        return [
            *_publishes(published, heard_as=published),
            *_answers([camera], asked_as=[camera]),
            *_hears(results),
            *_ros(domain),
        ]
    tokens = [f"{node}/alive", f"{node}/serves/*", f"{node}/instance/*"]
    reads = [
        *_hears(results),
        *_asks(asked),
        (IN, ["liveliness_query", "declare_liveliness_subscriber"], tokens),
        (OUT, ["liveliness_token"], tokens),
    ]
    if role == "recorder":  # as a consumer, and what drivers publish
        return [*reads, *_hears([events, camera, imu]), *_asks([camera])]
    if role == "operator":  # as a consumer, and model changes
        return [*reads, *_asks([change, drain]), *_answers([chunks], asked_as=[chunks])]
    return reads if role == "consumer" else []


def _ros(domain: int) -> list[Rule]:
    """List the keys of rmw_zenoh: messages and services, latched messages, and the tokens of nodes and topics."""
    keys = [f"{domain}/**", f"{domain}/**/@adv/**", f"@ros2_lv/{domain}/**"]
    return [(IN, ALL, keys), (OUT, ALL, keys)]


def _hears(keys: list[str]) -> list[Rule]:
    return [(IN, ["declare_subscriber"], keys), (OUT, ["put"], keys)]


def _publishes(keys: list[str], *, heard_as: list[str]) -> list[Rule]:
    return [(IN, ["put"], keys), (OUT, ["declare_subscriber"], heard_as)]  # else it learns of no subscriber


def _asks(keys: list[str]) -> list[Rule]:
    return [(IN, ["query"], keys), (OUT, ["declare_queryable", "reply"], keys)]


def _answers(keys: list[str], *, asked_as: list[str]) -> list[Rule]:
    return [(IN, ["declare_queryable", "reply"], keys), (OUT, ["query"], asked_as)]


def listens(certificate: Path) -> bool:
    """Return whether others may connect to the holder; make-ca.sh marks certificates that it made with hosts."""
    command = ["openssl", "x509", "-in", str(certificate), "-noout", "-purpose"]
    purposes = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    return "SSL server : Yes" in purposes


def config(folder: Path, name: str, access: dict[str, object], endpoint: str) -> str:
    """Return the text of a participant's configuration."""
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
    """Write a file atomically; only its owner can read it."""
    part = path.with_name(f".{path.name}")
    part.unlink(missing_ok=True)
    with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="utf-8") as file:
        file.write(text)
    part.replace(path)


def main() -> int:
    """Write the configurations of all participants in a folder."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", metavar="DIR", type=Path, help="folder with the certificates of make-ca.sh")
    parser.add_argument("--prefix", default="neurove/v1", help="prefix of all keys; default neurove/v1")
    parser.add_argument(
        "--listen", default="tls/0.0.0.0:7447", help="endpoint of router and listening nodes; default tls/0.0.0.0:7447"
    )
    parser.add_argument("--domain", type=int, default=0, help="ROS_DOMAIN_ID of the roles bridge and ros; default 0")
    args = parser.parse_args()
    if not re.fullmatch(r"[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*", args.prefix):
        parser.error(f"--prefix {args.prefix!r}: chunks of A-Z a-z 0-9 _ . - joined by /")
    if not re.fullmatch(r"tls/[^/\s\"#]+:[0-9]+", args.listen):
        parser.error(f"--listen {args.listen!r}: give one address and port, such as tls/192.168.7.1:7447")
    if not 0 <= args.domain <= 232:
        parser.error(f"--domain {args.domain}: 0 to 232")
    names = sorted(path.stem for path in args.folder.glob("*-*.crt") if path.name.split("-")[0] in ROLES)
    if not names:
        parser.error(f"no certificates in {args.folder}: run make-ca.sh first")
    access = access_control(names, args.prefix, args.domain)
    for name in names:
        write(args.folder / f"{name}.json5", config(args.folder, name, access, args.listen))
        print(f"wrote {args.folder / name}.json5")
    return 0


if __name__ == "__main__":
    sys.exit(main())
