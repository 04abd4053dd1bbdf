"""README and the other pages: the library example runs, links lead somewhere, and every command exists as written."""

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from neurove_service.cli.commands import build_parser
from tests.service.cli.test_language import PRIVATE

ROOT = Path(__file__).parents[1]
PAGES = sorted(
    page for page in ROOT.rglob("*.md") if not {".venv", ".git", "build"} & set(page.relative_to(ROOT).parts)
)
README = (ROOT / "README.md").read_text()
STANDS_FOR_A_PATH = re.compile(r"^(?:protocol|neurove_core|service|tests|deploy)/[\w./-]*$")


def commands(text: str) -> list[str]:
    """Every `neurove ...` in a page: lines of code blocks, split at `;`, and indented lines of commands."""
    blocks = re.findall(r"```sh\n(.*?)```", text, re.DOTALL)
    indented = re.findall(r"^ {4}(neurove .*)$", text, re.MULTILINE)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()] + indented
    parts = [part.strip() for line in lines for part in re.sub(r"(^|\s)#.*", "", line).split(";")]
    return [part for part in parts if part.startswith("neurove ")]


COMMANDS = [(page, command) for page in PAGES for command in commands(page.read_text())]


def test_the_first_screen_has_the_picture_the_install_line_and_the_two_commands() -> None:
    assert len(README.splitlines()) < 200
    first_screen = "\n".join(README.splitlines()[:32])
    for needed in ("![", "pip install", "make run", "make test", "from neurove_core import Estimator, load_model"):
        assert needed in first_screen


def test_the_library_example_has_six_lines_and_prints_velocities() -> None:
    (example,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert len([line for line in example.splitlines() if line]) <= 6
    printed = subprocess.run([sys.executable, "-c", example], capture_output=True, text=True, check=True, timeout=300)
    lines = printed.stdout.splitlines()
    assert len(lines) == 39  # 2 s in windows of 50 ms; the last one is not complete
    for line in lines:
        end_us, *twist = line.split()
        assert int(end_us) % 50_000 == 0
        assert len([float(number) for number in twist]) == 6


def test_the_first_example_of_evaluate_is_better_than_every_constant(run) -> None:
    examples = [command for command in commands(README) if command.startswith("neurove evaluate")]
    words = shlex.split(examples[0])[1:]
    code, out, _ = run(*words, "--json")
    report = json.loads(out)
    assert code == 0
    for name in ("rmse_v_l_m_s", "rmse_v_a_deg_s"):
        assert report[name] < min(report["mean"][name], report["zero"][name])


def test_the_second_block_of_commands_starts_one_service() -> None:
    block = re.findall(r"```sh\n(.*?)```", README, re.DOTALL)[1]
    assert block.count("neurove serve") == 1
    assert sum(command.startswith("neurove serve") for command in commands(README)) == 1


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_and_paths_lead_to_files(page: Path) -> None:
    text = page.read_text()
    links = [link.partition("#")[0] for link in re.findall(r"\]\(([^)\s]+)\)", text)]
    missing = [link for link in links if link and "://" not in link and not (page.parent / link).exists()]
    assert missing == []
    if page.name in ("CHANGELOG.md", "DECISIONS.md"):
        return  # they also name what is gone
    named = {code for code in re.findall(r"`([^`\n]+)`", text) if STANDS_FOR_A_PATH.match(code)}
    assert [code for code in sorted(named) if not (ROOT / code).exists() and not (page.parent / code).exists()] == []


def test_the_pages_hold_commands() -> None:
    assert len(COMMANDS) > 40


@pytest.mark.parametrize(("page", "command"), COMMANDS, ids=[command for _, command in COMMANDS])
def test_a_command_of_a_page_exists_with_its_flags(page: Path, command: str) -> None:
    plain = re.sub(r"\$\([^)]*\)", "FILE", command)  # what a shell puts there
    plain = re.sub(r"\[[^\]]*\|[^\]]*\]", "", plain)  # one of several words
    words = shlex.split(re.split(r"\s(?:\||>|&&)\s", plain)[0])[1:]
    parser = build_parser({words[0]})
    try:
        parser.check_words(words)
        parser.parse_args(words)
    except SystemExit as error:
        if error.code:
            pytest.fail(f"{page.name}: {command}")


@pytest.mark.parametrize(
    "page",
    # results/ holds what `neurove reproduce` wrote; CHANGELOG names fields
    [page for page in PAGES if page.name != "CHANGELOG.md" and page.parent.name != "results"],
    ids=lambda page: str(page.relative_to(ROOT)),
)
def test_a_page_has_no_private_word(page: Path) -> None:
    prose = re.sub(r"```.*?```|`[^`]*`", "", page.read_text(), flags=re.DOTALL)
    found = sorted({match[0] for match in PRIVATE.finditer(prose)})
    assert found == []
