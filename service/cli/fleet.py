"""The commands about all nodes of a deployment: `neurove fleet list`."""

import argparse
import json
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from neurove_protocol.control import HealthReply
from neurove_protocol.errors import EXIT_FAILURE, InvalidField
from neurove_service.cli.arguments import add_client_flags, client_config, seconds, subcommand
from neurove_service.cli.parser import Parser
from neurove_service.cli.waiting import Wait, add_wait

_PIPED_WIDTH: Final = 1000  # characters: a line of a pipe or a file is never wrapped

if TYPE_CHECKING:
    from neurove_service.fleet.inventory import Expected
    from neurove_service.fleet.roster import Roster
    from neurove_service.fleet.where import Condition


def listed(args: argparse.Namespace) -> int:
    """List the nodes of a deployment, and those that do not answer; exit code 1 if one is silent or not ok."""
    from neurove_service.clients import ask
    from neurove_service.fleet import inventory, roster, where

    if args.update and args.expect_nodes is None:
        raise InvalidField("fleet list", "--update", "", "it writes the file of --expect-nodes: give that too")
    conditions = [where.Condition.parse(text) for text in args.where]
    expected = expected_nodes(args.expect_nodes, create=args.update)
    config = client_config(args)
    wait = Wait(config, args.wait)
    with wait.connect(config) as transport:
        if not expected:  # otherwise the answer is that they are not there
            wait.until(lambda: ask.need_service(transport, config))
        found = roster.ask(transport, config, expected, args.timeout)
    now = datetime.now(UTC)
    if args.update:
        inventory.update(args.expect_nodes, {name: one.labels for name, one in found.replies.items()}, now)
    rows = _rows(found, expected, conditions, now)
    if args.json:
        print(json.dumps(rows))
    else:
        _print(rows)
    return 0 if rows and all(row["ok"] for row in rows) else EXIT_FAILURE


def expected_nodes(path: Path | None, *, create: bool = False) -> "dict[str, Expected]":
    """The nodes of the file of `--expect-nodes`; none without it, or if it is created."""
    from neurove_service.fleet import inventory

    return {} if path is None or (create and not path.exists()) else inventory.read(path)


def _rows(
    found: "Roster", expected: "Mapping[str, Expected]", conditions: "list[Condition]", now: datetime
) -> list[dict[str, Any]]:
    """A row for each node that meets the conditions; a silent one without known labels might meet them, and has one."""
    from neurove_service.fleet import where

    rows = [
        _of_reply(reply, now) for reply in found.replies.values() if where.selected(where.facts_of(reply), conditions)
    ]
    for node, why in found.silent.items():
        known = expected.get(node)
        facts = {"node": node} | dict(known.labels if known else {})
        if all(one.name not in facts or one.holds(facts) for one in conditions):
            rows.append(_of_silence(node, why, known))
    return sorted(rows, key=lambda row: str(row["node"]))


def _of_reply(reply: HealthReply, now: datetime) -> dict[str, Any]:
    return {
        "node": reply.node,
        "answered": True,
        "labels": dict(reply.labels),
        "version": reply.version,
        "model": reply.model.name,
        "digest": reply.model.digest,
        "release": reply.model.release,
        "ok": reply.ok,
        "why": reply.why,
        "last_seen": now.isoformat(timespec="seconds"),
        "epoch": reply.epoch,
        "rollbacks": reply.rollbacks,
        "uptime_s": reply.uptime_s,
        "streams": len(reply.streams),
    }


def _of_silence(node: str, why: str, known: "Expected | None") -> dict[str, Any]:
    nothing = dict.fromkeys(
        ("version", "model", "digest", "release", "ok", "epoch", "rollbacks", "uptime_s", "streams")
    )
    seen = known.seen.isoformat(timespec="seconds") if known is not None and known.seen is not None else None
    about = {"node": node, "answered": False, "labels": dict(known.labels) if known else {}}
    return about | nothing | {"why": why, "last_seen": seen}


def _print(rows: list[dict[str, Any]]) -> None:
    from neurove_service.cli.console import console
    from neurove_service.cli.views import fleet_table

    width = None if sys.stdout.isatty() else _PIPED_WIDTH
    console(width=width).print(fleet_table(rows, datetime.now(UTC)))
    silent = [row for row in rows if not row["answered"]]
    bad = sum(row["ok"] is False for row in rows)
    counts = f"{len(rows)} nodes: {len(rows) - len(silent) - bad} ok, {bad} not ok, {len(silent)} do not answer"
    print(counts, flush=True)
    for row in silent:
        print(f"neurove: node {row['node']} {row['why']}", file=sys.stderr)


def add_fleet(parser: Parser) -> None:
    """Add the commands of `neurove fleet`."""
    one = subcommand(parser.add_commands(), "list", listed)
    add_client_flags(one)
    add_wait(one)
    add_selection(one)
    about = "write labels and times of the nodes that answer to the file of --expect-nodes, and add new nodes to it"
    one.add_argument("--update", action="store_true", help=about)


def add_selection(parser: argparse.ArgumentParser) -> None:
    """Add which nodes a command is about, and how long it waits for their answers."""
    about = (
        "select nodes: a label, or node, model, digest, release, version or verdict (ok, not-ok); `*` stands for any "
    )
    about += "characters; several conditions must all hold"
    parser.add_argument("--where", action="append", default=[], metavar="NAME=VALUE", help=about)
    about = "text file of the nodes that should answer: one node a line, then its labels as NAME=VALUE"
    parser.add_argument("--expect-nodes", type=Path, metavar="FILE", help=about)
    about = "longest wait for the answers of all nodes; default 3"
    parser.add_argument("--timeout", type=seconds, default=3.0, metavar="S", help=about)
