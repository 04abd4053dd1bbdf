"""The command that changes many nodes step by step: `neurove rollout`.

Exit code 0: every node is fine; 4: some are; 1: none is, such as after a stop whose nodes were all reverted.
"""

import argparse
import contextlib
import json
import sys
import time
from collections.abc import Callable
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from neurove_protocol.errors import InvalidField
from neurove_service.cli.arguments import MAX_SECONDS, add_client_flags, client_config, command, count
from neurove_service.cli.changing import MAX_SHADOW_S, digest_prefix
from neurove_service.cli.fleet import add_selection, expected_nodes
from neurove_service.cli.waiting import Wait, add_wait
from neurove_service.config import ClientConfig

if TYPE_CHECKING:
    from neurove_service.clients.push_source import PushSource
    from neurove_service.fleet.journal import Event, Journal
    from neurove_service.fleet.ledger import Terms
    from neurove_service.fleet.rollout import Turn
    from neurove_service.fleet.selection import Selection

_UNITS: Final = {"s": 1.0, "m": 60.0, "h": 3600.0}
_TURN_S: Final = 30.0  # between two lines about where a rollout is
_SHOWN: Final = 12  # nodes that one line names
_OF_A_NEW_ONE: Final = ("plan", "soak", "grace", "patience", "shadow", "expect", "on_failure", "parallel", "journal")
_DEFAULTS: Final = {"plan": "1,10%,100%", "soak": 600.0, "grace": 10.0, "patience": 60.0, "shadow": 0.0, "parallel": 8}


def rollout(args: argparse.Namespace) -> int:
    """Change the model of many nodes step by step, and stop or go back if one fails."""
    return _resumed(args) if args.resume is not None else _new(args)


def _new(args: argparse.Namespace) -> int:
    from neurove_service.clients import ask
    from neurove_service.clients.push_source import PushSource
    from neurove_service.fleet import roster, where
    from neurove_service.fleet.journal import Journal, check_new
    from neurove_service.fleet.ledger import start_fields
    from neurove_service.fleet.selection import select

    if args.bundle is None:
        raise InvalidField("rollout", "BUNDLE", "", "give the bundle, or --resume JOURNAL")
    conditions = [where.Condition.parse(text) for text in args.where]
    expected = expected_nodes(args.expect_nodes)
    config = client_config(args)
    path = args.journal or Path(f"rollout-{args.bundle.stem}-{datetime.now(UTC):%Y%m%dT%H%M%SZ}.jsonl")
    if not args.dry_run:
        check_new(path)
    with PushSource(args.bundle) as source:
        terms = _terms(args, source)
        wait = Wait(config, args.wait)
        with wait.connect(config) as transport:
            wait.until(lambda: ask.need_service(transport, config))
            found = roster.ask(transport, config, expected, args.timeout)
            chosen = select(found, expected, conditions, source.digest, terms.expect)
            if not chosen.targets and not chosen.already:
                raise InvalidField("rollout", "--where", " ".join(args.where), "no node meets the conditions")
            if args.dry_run:
                print(json.dumps(_plan_json(terms, chosen)) if args.json else _plan_text(terms, chosen), flush=True)
                return 0
            with Journal(path, new=True) as journal:
                start = journal.append("start", start_fields(terms, chosen))
                journal.events.append(start)
                if args.json:
                    print(json.dumps(start), flush=True)
                else:
                    print(f"{_plan_text(terms, chosen)}\njournal: {path}", flush=True)
                return _run(args, transport, config, journal, source)


def _resumed(args: argparse.Namespace) -> int:
    from neurove_service.clients.push_source import PushSource
    from neurove_service.fleet.journal import Journal
    from neurove_service.fleet.ledger import Ledger

    given = [name for name in _OF_A_NEW_ONE if getattr(args, name) is not None] + ["where"] * bool(args.where)
    given += ["expect_nodes"] * (args.expect_nodes is not None) + ["dry_run"] * args.dry_run
    if given:
        flag = f"--{given[0].replace('_', '-')}"
        raise InvalidField("rollout", flag, "", "the journal has it: with --resume only --max-failed may change")
    config = client_config(args)
    with Journal(args.resume, new=False) as journal:
        ledger = Ledger(journal.events)
        bundle = args.bundle or Path(ledger.terms.bundle)
        with PushSource(bundle) as source:
            if source.digest != ledger.terms.digest:
                bound = f"the journal is about the bundle {ledger.terms.digest[:12]}"
                raise InvalidField("rollout", "BUNDLE", f"{bundle} ({source.digest[:12]})", bound)
            wait = Wait(config, args.wait)
            with wait.connect(config) as transport:
                most = ledger.max_failed if args.max_failed is None else args.max_failed
                resume = journal.append("resume", {"max_failed": most})
                journal.events.append(resume)
                _printer(args)(resume)
                if ledger.stopped and most <= ledger.max_failed:
                    about = f"the rollout has stopped: {ledger.stopped}; a larger --max-failed lets it go on"
                    print(f"neurove: {about}", file=sys.stderr, flush=True)
                return _run(args, transport, config, journal, source)


def _run(
    args: argparse.Namespace, transport: Any, config: ClientConfig, journal: "Journal", source: "PushSource"
) -> int:
    from neurove_protocol.control import CHUNK_SCHEMA
    from neurove_service.fleet.changing import Changer
    from neurove_service.fleet.ledger import Ledger
    from neurove_service.fleet.rollout import Rollout

    transport.answer(config.keys.chunks(source.digest), source.chunk, CHUNK_SCHEMA)
    changer = Changer(transport, config, Ledger(journal.events).terms, source.request)
    run = Rollout(transport, config, journal, changer, _printer(args), _Turns(quiet=args.json))
    try:
        return run.run()
    except KeyboardInterrupt:
        print(f"neurove: interrupted; go on with: neurove rollout --resume {journal.path}", file=sys.stderr, flush=True)
        raise


def _terms(args: argparse.Namespace, source: "PushSource") -> "Terms":
    from neurove_service.fleet import plan
    from neurove_service.fleet.ledger import Terms

    def given(name: str) -> Any:
        value = getattr(args, name)
        return _DEFAULTS[name] if value is None else value

    return Terms(
        bundle=str(args.bundle.absolute()),
        name=args.bundle.stem,
        digest=source.digest,
        steps=plan.parse(given("plan")),
        soak_s=given("soak"),
        grace_s=given("grace"),
        max_failed=args.max_failed or 0,
        patience_s=given("patience"),
        shadow_s=given("shadow"),
        expect=args.expect,
        on_failure=args.on_failure or "batch",
        parallel=given("parallel"),
    )


def _plan_json(terms: "Terms", chosen: "Selection") -> dict[str, Any]:
    return {"digest": terms.digest, "steps": _steps(terms, chosen)} | {
        name: getattr(chosen, name) for name in ("already", "skipped", "unknown")
    }


def _steps(terms: "Terms", chosen: "Selection") -> list[list[str]]:
    """The nodes of each step, if all of them answer when their turn comes."""
    from neurove_service.fleet import plan

    nodes = [node for node in chosen.targets if node not in chosen.skipped]
    sizes = [0, *plan.sizes(terms.steps, len(nodes))]
    return [nodes[first:last] for first, last in pairwise(sizes)]


def _plan_text(terms: "Terms", chosen: "Selection") -> str:
    steps = _steps(terms, chosen)
    changed = sum(map(len, steps))
    shadow = f"shadow of {terms.shadow_s:g} s, " if terms.shadow_s else ""
    lines = [
        f"rollout of {terms.name} ({terms.digest[:12]}) to {changed} nodes: {shadow}soak of {terms.soak_s:g} s, "
        f"at most {terms.max_failed} may fail"
    ]
    lines += [f"  step {number}: {len(nodes)} nodes: {_names(nodes)}" for number, nodes in enumerate(steps, 1)]
    left = len(chosen.targets) - len(chosen.skipped) - changed
    if left:
        lines.append(f"  not in the plan: {left} nodes")
    if chosen.already:
        lines.append(f"  serve it already: {_names(chosen.already)}")
    lines += [f"  skipped: {node}: {why}" for node, why in chosen.skipped.items()]
    lines += [f"  unknown: {node} {why}; its labels are not known" for node, why in chosen.unknown.items()]
    return "\n".join(lines)


def _names(nodes: Any) -> str:
    shown = list(nodes)[:_SHOWN]
    return ", ".join(shown) + (f" and {len(nodes) - len(shown)} more" if len(nodes) > len(shown) else "")


def _printer(args: argparse.Namespace) -> "Callable[[Event], None]":
    def show(event: "Event") -> None:
        print(json.dumps(event) if args.json else _text(event), flush=True)

    return show


def _text(event: "Event") -> str:
    kind, clock = event["event"], f"{datetime.fromisoformat(event['at']).astimezone():%H:%M:%S}"
    why = f": {event['why']}" if event.get("why") else ""
    if kind == "end":
        return "\n".join([f"{clock} end", *_summary_lines(event["summary"])])
    return f"{clock} {_about(event, why)}"


def _about(event: "Event", why: str) -> str:
    match event["event"]:
        case "step":
            return f"step {event['number']}: {event['size']} of {event['of']} nodes"
        case "change":
            return f"{event['node']}: push and activate"
        case "active":
            return f"{event['node']}: active, soak of {event['soak_s']:g} s begins"
        case "kept":
            return f"{event['node']}: not reverted{why}"
        case "offline":
            return f"{event['node']}: not changed{why}"
        case "stop" | "resume" as kind:
            return f"{kind}{why}"
        case kind:
            return f"{event['node']}: {kind}{why}"


def _summary_lines(summary: dict[str, dict[str, str]]) -> list[str]:
    counts = ", ".join(f"{len(nodes)} {kind}" for kind, nodes in summary.items() if nodes)
    width = max((len(node) for nodes in summary.values() for node in nodes), default=0)
    lines = [f"summary of {sum(map(len, summary.values()))} nodes: {counts}"]
    return lines + [
        f"  {node:{width}}  {kind}: {why}" for kind, nodes in summary.items() for node, why in sorted(nodes.items())
    ]


class _Turns:
    """Prints where a rollout is, now and then."""

    def __init__(self, *, quiet: bool) -> None:
        self._quiet, self._next_s = quiet, time.monotonic() + _TURN_S

    def __call__(self, turn: "Turn") -> None:
        """Take the present state."""
        if self._quiet or time.monotonic() < self._next_s:
            return
        self._next_s = time.monotonic() + _TURN_S
        left = f", {turn.left_s:.0f} s left" if turn.soaking else ""
        about = f"{turn.changing} change, {turn.soaking} in their soak{left}, {turn.fine} fine, {turn.failed} failed"
        print(f"step {turn.step}: {about}, {turn.pending} not changed", flush=True)


def span(text: str) -> float:
    """A time above 0: seconds, or a number with the unit s, m or h, such as 10m [s]."""
    number, unit = (text[:-1], _UNITS[text[-1]]) if text[-1:] in _UNITS else (text, 1.0)
    with contextlib.suppress(ValueError):
        if 0 < (value := float(number) * unit) <= MAX_SECONDS:
            return value
    raise argparse.ArgumentTypeError(f"{text!r}: give a time above 0, such as 90, 90s, 10m or 2h")


def _shadow(text: str) -> float:
    value = span(text)
    if value > MAX_SHADOW_S:
        raise argparse.ArgumentTypeError(f"{text!r}: give at most 1h")
    return value


def _failures(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and len(text) <= 6):
        raise argparse.ArgumentTypeError(f"{text!r}: give a whole number, 0 or more")
    return int(text)


def _parallel(text: str) -> int:
    value = count(text)
    if value > 64:
        raise argparse.ArgumentTypeError(f"{text!r}: give at most 64")
    return value


def add_rollout(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `neurove rollout`."""
    add_client_flags(command(parser, rollout))
    add_wait(parser)
    about = "bundle to send, with BUNDLE.sig if it exists; with --resume: where it is now, if it was moved"
    parser.add_argument("bundle", nargs="?", type=Path, metavar="BUNDLE", help=about)
    add_selection(parser)
    about = "nodes that have the bundle after each step, as counts or shares; default 1,10%%,100%%"
    parser.add_argument("--plan", metavar="STEPS", help=about)
    _add_times(parser)
    about = "stop if more nodes fail; default 0. If all nodes of a step fail, it stops in any case"
    parser.add_argument("--max-failed", type=_failures, metavar="N", help=about)
    about = "what a stop does: revert the nodes of the step (batch, the default), revert all nodes, or leave them "
    about += "(stop); with batch and all, a node that fails is reverted at once"
    parser.add_argument("--on-failure", choices=("batch", "all", "stop"), help=about)
    about = "change only nodes that serve this model"
    parser.add_argument("--expect", type=digest_prefix, metavar="DIGEST", help=about)
    parser.add_argument("--parallel", type=_parallel, metavar="N", help="nodes that change at once; default 8")
    about = "file for the journal; default: rollout-NAME-TIME.jsonl in the current folder"
    parser.add_argument("--journal", type=Path, metavar="FILE", help=about)
    about = "go on with a rollout that was killed, interrupted, stopped or left nodes out"
    parser.add_argument("--resume", type=Path, metavar="JOURNAL", help=about)
    parser.add_argument("--dry-run", action="store_true", help="show the plan and change nothing")


def _add_times(parser: argparse.ArgumentParser) -> None:
    about = "how long each node is watched after its activation, such as 90s or 10m; default 10m"
    parser.add_argument("--soak", type=span, metavar="TIME", help=about)
    about = "a node that is not ok for so long fails; default 10s"
    parser.add_argument("--grace", type=span, metavar="TIME", help=about)
    about = "how long nodes that do not answer are retried in each step; default 60s"
    parser.add_argument("--patience", type=span, metavar="TIME", help=about)
    about = "time that the bundle runs in shadow on each node before it becomes active; default: none"
    parser.add_argument("--shadow", type=_shadow, metavar="TIME", help=about)
