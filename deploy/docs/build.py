"""Build the documentation site: collect the pages of the repository, write the API reference, run Zensical.

Usage: python deploy/docs/build.py OUT. The site is OUT/site. A broken link ends the build with exit code 1.
"""

import ast
import importlib
import inspect
import itertools
import re
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

from diagrams import FENCE, file_of

ROOT = Path(__file__).resolve().parents[2]
CONFIG = Path(__file__).with_name("mkdocs.yml")
LINK = re.compile(r"\]\(([^)\s#]+)(#[^)\s]*)?\)")
SECTION = re.compile(r"^(Args|Returns|Raises|Yields|Source|Differs|Attributes):[ ]*(.*)$")

MAX_SIGNATURE = 90

REFERENCE = {
    "neurove_core": (
        "Estimate velocities in Python",
        ("neurove_core.estimator", "neurove_core.models", "neurove_core.models.bundle", "neurove_core.config"),
    ),
    "neurove_protocol": (
        "Messages, keys and errors",
        (
            "neurove_protocol.events",
            "neurove_protocol.velocity",
            "neurove_protocol.camera",
            "neurove_protocol.imu",
            "neurove_protocol.control",
            "neurove_protocol.keys",
            "neurove_protocol.errors",
        ),
    ),
    "spiking": (
        "Neurons and cells of the paper",
        (
            "neurove_core.spiking.lif",
            "neurove_core.spiking.alif",
            "neurove_core.spiking.ltc",
            "neurove_core.spiking.slstm",
            "neurove_core.spiking.aslstm",
            "neurove_core.spiking.readout",
            "neurove_core.spiking.surrogate",
        ),
    ),
    "recordings": (
        "Recordings, simulation, geometry",
        (
            "neurove_core.sources",
            "neurove_core.io.recording",
            "neurove_core.io.calibration",
            "neurove_core.geometry.camera",
            "neurove_core.geometry.motion",
            "neurove_core.geometry.rotations",
        ),
    ),
    "training": (
        "Training and evaluation",
        ("neurove_core.training.pipeline", "neurove_core.training.config", "neurove_core.evaluation.metrics"),
    ),
}


def pages() -> list[Path]:
    """Pages of the repository, relative to its root: every Markdown file that the navigation names or another links."""
    named = re.findall(r": ([\w./-]+\.md)$", CONFIG.read_text(), re.MULTILINE)
    found: dict[Path, None] = {}
    waiting = [Path(name) for name in named if not name.startswith("reference/")]
    while waiting:
        page = waiting.pop()
        if page not in found:
            found[page] = None
            waiting += [link for link in links_of(page) if link.suffix == ".md"]
    return sorted(found)


def links_of(page: Path) -> Iterator[Path]:
    """Files of the repository that a page links, relative to the root; pages of the reference are left out."""
    for target, _ in LINK.findall((ROOT / page).read_text(encoding="utf-8")):
        if "://" in target or target.startswith("mailto:"):
            continue
        path = (ROOT / page.parent / target).resolve()
        if path.is_relative_to(ROOT) and path.is_file():
            yield path.relative_to(ROOT)


def collect(into: Path) -> None:
    """Copy every page and every file that a page links, with their paths in the repository."""
    for page in pages():
        for path in (page, *links_of(page)):
            (into / path.parent).mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / path, into / path)


def picture_diagrams(into: Path) -> None:
    """Replace each Mermaid diagram, which a script from another host would draw, by its committed picture.

    Raises:
        SystemExit: a diagram has no picture, because its text changed.
    """
    for page in into.rglob("*.md"):
        text = page.read_text(encoding="utf-8")
        for diagram in FENCE.findall(text):
            picture = file_of(diagram)
            if not picture.is_file():
                sys.exit(f"{page.relative_to(into)}: a diagram has no picture: run deploy/docs/diagrams.py")
            target = into / picture.relative_to(ROOT)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(picture, target)
            steps = "../" * len(page.relative_to(into).parent.parts)
            image = f"![diagram]({steps}{picture.relative_to(ROOT).as_posix()})\n"
            text = text.replace(f"```mermaid\n{diagram}```\n", image)
        page.write_text(text, encoding="utf-8")


def write_reference(into: Path) -> None:
    """Write one page for each entry of REFERENCE."""
    into.mkdir(parents=True, exist_ok=True)
    for name, (title, modules) in REFERENCE.items():
        parts = [f"# {title}\n"]
        for module in modules:
            parts += described(importlib.import_module(module))
        (into / f"{name}.md").write_text("\n".join(parts), encoding="utf-8")


def described(module: ModuleType) -> Iterator[str]:
    """The public classes and functions that a module defines, with shapes, units and errors from their docstrings."""
    yield f"## `{module.__name__}`\n"
    yield text_of(module)
    yield from constants(module)
    for name, member in vars(module).items():
        own = getattr(member, "__module__", None) == module.__name__ or name in getattr(module, "__all__", ())
        if name.startswith("_") or not own:
            continue
        if inspect.isclass(member):
            yield f"### {name}\n"
            yield f"```python\nclass {name}{signature(member)}\n```\n"
            yield text_of(member)
            yield from fields(member)
            yield from methods(name, member)
        elif inspect.isroutine(member):
            yield f"### {name}\n"
            yield f"```python\ndef {name}{signature(member)}\n```\n"
            yield text_of(member)


def constants(module: ModuleType) -> Iterator[str]:
    """The public constants of a module that have a docstring of their own, with their values."""
    for before, after in itertools.pairwise(ast.parse(inspect.getsource(module)).body):
        if not (isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)):
            continue
        match before:
            case ast.Assign(targets=[ast.Name(id=name)]) | ast.AnnAssign(target=ast.Name(id=name)):
                value = ast.unparse(before.value) if before.value is not None else ""
                shown = f" = `{value}`" if len(value) <= MAX_SIGNATURE else ""
                if not name.startswith("_"):
                    yield f"- `{name}`{shown}: {escaped(' '.join(str(after.value.value).split()))}"
    yield ""


def fields(kind: type) -> Iterator[str]:
    """The annotated fields of a class; the comment behind a field has its shape, unit or meaning."""
    lines = inspect.getsource(kind).splitlines()
    body = ast.parse(textwrap.dedent("\n".join(lines))).body[0]
    assert isinstance(body, ast.ClassDef)
    for node in body.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and not node.target.id.startswith("_"):
            comment = lines[(node.end_lineno or 1) - 1].partition("  # ")[2]
            if not comment.startswith(("noqa", "type:")):
                about = f": {escaped(comment)}" if comment else ""
                yield f"- `{node.target.id}`{about}"
    yield ""


def methods(owner: str, kind: type) -> Iterator[str]:
    """The public methods and properties of a class that have a docstring."""
    for name, member in vars(kind).items():
        inner = member.__func__ if isinstance(member, classmethod | staticmethod) else member
        if name.startswith("_") or not getattr(inner, "__doc__", None):
            continue
        if isinstance(inner, property):
            yield f"#### {owner}.{name}\n"
            yield text_of(inner)
        elif inspect.isfunction(inner):
            yield f"#### {owner}.{name}\n"
            yield f"```python\ndef {name}{signature(inner)}\n```\n"
            yield text_of(inner)


def signature(member: object) -> str:
    """Parameters and result as text; empty where Python does not know them."""
    try:
        text = str(inspect.signature(member))  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return ""
    text = re.sub(r"<(?:function|class|factory|object) ?([^>]*?)(?: at 0x\w+)?>", r"\1", text)
    text = re.sub(r"\b(?:neurove_\w+|typing|collections\.abc|pathlib|numpy|torch)\.(?:\w+\.)*", "", text)
    return text if len(text) <= MAX_SIGNATURE else wrapped(text)


def wrapped(text: str) -> str:
    """A signature with one parameter a line: it is split at the commas that stand in no inner bracket."""
    depth, lines, begin = 0, [], 1
    for place, sign in enumerate(text):
        depth += (sign in "([{") - (sign in ")]}")
        if depth == 0:  # the end of the parameters
            return "\n".join(("(", *lines, f"    {text[begin:place].strip()},", text[place:]))
        if sign == "," and depth == 1:
            lines.append(f"    {text[begin : place + 1].strip()}")
            begin = place + 1
    return text


def text_of(member: object) -> str:
    """A docstring as Markdown: sections become bold words and lists, examples become code."""
    lines, out, listing, code = inspect.cleandoc(getattr(member, "__doc__", None) or "").splitlines(), [], False, False
    for line in lines:
        section = SECTION.match(line)
        is_code = line.lstrip().startswith(">>>") or (code and bool(line.strip()))
        if is_code != code:
            out.append("```python" if is_code else "```")
            code = is_code
        if code:
            out.append(line)
        elif section:
            listing = not section[2]
            out += ["", f"**{section[1]}**: {section[2]}".rstrip(": ") if section[2] else f"**{section[1]}**", ""]
        elif listing and line.startswith("    ") and not line.startswith("     "):
            name, colon, about = line.strip().partition(": ")
            out.append(f"- `{name}`: {escaped(about)}" if colon and " " not in name else f"- {escaped(line.strip())}")
        elif listing and line.startswith("     "):
            out.append(f"  {escaped(line.strip())}")
        else:
            listing = listing and not line.strip()
            out.append(escaped(line))
    if code:
        out.append("```")
    return "\n".join(out) + "\n"


def escaped(text: str) -> str:
    """Text in which brackets and stars stay as they are, except inside back ticks."""
    parts = re.split(r"(`[^`]*`)", text)
    return "".join(part if part.startswith("`") else re.sub(r"([\[\]*<_])", r"\\\1", part) for part in parts)


def build(out: Path) -> int:
    """Build the site below a folder; returns the exit code of Zensical."""
    shutil.rmtree(out, ignore_errors=True)
    collect(out / "pages")
    picture_diagrams(out / "pages")
    write_reference(out / "pages" / "reference")
    shutil.copyfile(CONFIG, out / "mkdocs.yml")
    zensical = Path(sys.executable).with_name("zensical")
    return subprocess.run(
        [zensical, "build", "--strict", "--config-file", "mkdocs.yml"], cwd=out, check=False
    ).returncode


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    sys.exit(build(Path(sys.argv[1])))
